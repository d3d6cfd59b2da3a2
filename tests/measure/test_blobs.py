"""Gaussian blobs on a film: what pixels tell of them becomes what points tell, as the blobs shrink.

The image is I(u) = Σ_k g_k G_s(u − π(X_k)), G_s a Gaussian of unit flux and standard deviation s [pixel], the
gains g_k unknown. Alone, a blob's position has the information g² ∫ ∂G ∂Gᵀ / σ² = g² / (8π s⁴ σ²) about
either axis, and by symmetry nothing to lose to its gain: the best estimate of its centroid has the standard
deviation √(8π) s² σ / g [pixel]. Blobs that do not overlap are K points measured that well.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import eigvalsh, expm

from mitsuba_crb import se3
from mitsuba_crb.agents.bundle import PointView, point_information
from mitsuba_crb.camera import Camera
from mitsuba_crb.information.image_jacobian import ImageJacobian
from mitsuba_crb.information.joint import joint_information
from mitsuba_crb.information.linearisation import Linearisation, PixelSelection
from mitsuba_crb.noise import Gaussian

SIZE = (160, 120)
CAMERA = Camera.pinhole(140.0, centre=(80.0, 60.0), size=(160, 120))
SIGMA = 0.01
# Film positions at least 37 pixels apart and 20 from the border, and depths.
FILM = np.array(
    [[22.0, 21.0], [78.0, 25.0], [137.0, 22.0], [25.0, 62.0], [83.0, 64.0], [136.0, 66.0], [40.0, 99.0]]
)
DEPTHS = np.array([2.0, 5.0, 3.0, 4.0, 2.5, 6.0, 3.5])
GAINS = np.array([3.0, 1.0, 2.0, 5.0, 1.5, 4.0, 2.5])
POINTS = CAMERA.directions(FILM) * DEPTHS[:, None]
PIXELS = np.stack(np.meshgrid(*(np.arange(n) for n in SIZE)), axis=-1).reshape(-1, 2)


def blobs(film, width):
    """G_s(u − π_k) at all pixels, (n, K), for real or complex film positions (K, 2)."""
    offset = PIXELS[:, None] + 0.5 - film
    return np.exp(-(offset**2).sum(axis=2) / (2.0 * width**2)) / (2.0 * np.pi * width**2)


def image_jacobian(points, gains, width):
    """The whole image's exact derivative in the pose, by complex steps, and in the gains."""
    step, columns = 1e-30, []
    for direction in np.eye(6):
        generator = np.zeros((4, 4))
        generator[:3, :3] = se3.skew(direction[3:])
        generator[:3, 3] = direction[:3]
        camera_from_moved = expm(-1j * step * generator)
        p = points @ camera_from_moved[:3, :3].T + camera_from_moved[:3, 3]
        film = np.asarray(CAMERA.centre) - np.asarray(CAMERA.focal) * p[:, :2] / p[:, 2:]
        columns.append((blobs(film, width) @ gains).imag / step)
    shapes = blobs(CAMERA.project(points), width)
    values = np.column_stack([*columns, shapes])[:, None]
    return ImageJacobian(
        batch_values=np.broadcast_to(values, (4, *values.shape)),
        pixels=PIXELS,
        image=(shapes @ gains).reshape(SIZE[1], SIZE[0], 1),
        linearisation=Linearisation(
            variable="camera",
            frame="camera",
            pose=np.eye(4),
            length_scale=float(np.median(points[:, 2])),
            selection=PixelSelection("all", len(PIXELS), len(PIXELS), "all"),
        ),
        block=16,
        parameters=tuple(f"gain {k}" for k in range(len(points))),
    )


def centroid_std(gains, width):
    """The closed form, [pixel]."""
    return np.sqrt(8.0 * np.pi) * width**2 * SIGMA / gains


@pytest.mark.parametrize(("width", "tolerance"), [(1.0, 2e-3), (1.5, 1e-8), (3.0, 1e-8)])
def test_one_blob_s_position_has_the_closed_form_s_bound(width, tolerance):
    """Pixels sample ∂G∂Gᵀ with an error of order exp(−π² s²)."""
    film, step = FILM[4] + (0.3, -0.2), 1e-30
    columns = [GAINS[4] * blobs(film + 1j * step * axis, width)[:, 0].imag / step for axis in np.eye(2)]
    J = np.column_stack([*columns, blobs(film, width)[:, 0]]) / SIGMA
    covariance = np.linalg.inv(J.T @ J)[:2, :2]
    expected = centroid_std(GAINS[4], width) ** 2
    assert np.abs(covariance - expected * np.eye(2)).max() < tolerance * expected


class TestManyBlobs:
    def _shares(self, width):
        """Generalised eigenvalues (6,) of the pixels' information in units of the points'."""
        joint = joint_information(image_jacobian(POINTS, GAINS, width), Gaussian(SIGMA))
        pixels = joint.marginalize(*joint.names).information
        view = PointView("camera", np.eye(4), CAMERA, centroid_std(GAINS, width))
        return eigvalsh(pixels.matrix, point_information(POINTS, view).matrix)

    @pytest.mark.slow
    def test_pixels_tell_what_points_tell_as_blobs_shrink(self):
        """Overlap falls as exp(−d²/4s²), d ≥ 37 pixels; the film's border cuts the widest blobs."""
        departures = [np.abs(self._shares(width) - 1.0).max() for width in (16.0, 8.0, 4.0, 2.0)]
        assert departures[0] > 0.1
        assert all(later < earlier for earlier, later in pairwise(departures))
        assert departures[-1] < 1e-8

    def test_points_measured_another_way_differ(self):
        """Negative control: points measured as blobs of twice the width tell a sixteenth."""
        view = PointView("camera", np.eye(4), CAMERA, centroid_std(GAINS, 4.0))
        joint = joint_information(image_jacobian(POINTS, GAINS, 2.0), Gaussian(SIGMA))
        shares = eigvalsh(
            joint.marginalize(*joint.names).information.matrix, point_information(POINTS, view).matrix
        )
        np.testing.assert_allclose(shares, 16.0, rtol=1e-6)

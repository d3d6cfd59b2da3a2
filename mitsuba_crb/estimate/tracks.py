"""Feature tracks of a scene's views: corners for bundle adjustment, and how well each of them is seen.

A window of known appearance that moves by d on the film has the information T = Σ_u ∇I Σ⁻¹ ∇Iᵀ about d, its
structure tensor, so that T⁻¹ [pixel²] is the covariance of the best estimate of d. That estimate follows the
weighted mean f̄ = T⁻¹ Σ T_u f_u of the flow in the window, for a zoom exactly the flow at

    u* = T⁻¹ Σ T_u u,

which is why the corner is put there (Förstner's point) and lifted to 3D. ∇I comes from the same Jacobian as
the photometric bound: a rotation's flow f_φ knows no depth, so ∂I/∂φ = −∇I f_φ, solved for ∇I with pitch and
yaw; products of independent batches (`ustatistic`) keep Monte Carlo noise out of T.

Points tell less than their windows' pixels, Σ f_uᵀ T_u f_u = f̄ᵀ T f̄ + Σ (f_u − f̄)ᵀ T_u (f_u − f̄). Of this,
bundle adjustment has the first term, with f(u*) for f̄. In its worst direction, where translation and rotation
look alike and only their difference counts, that overstates the windows of `textured_room` by 12 % at
128 x 96 pixels and by 2 % at 256 x 192, and is still less than 30 % of the whole image's information.

References: Förstner and Gülch, "A fast operator for detection and precise location of distinct points,
corners and centres of circular features", 1987; Shi and Tomasi, "Good features to track", 1994.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from skimage.feature import corner_peaks, corner_shi_tomasi

from .. import se3
from ..agents.bundle import FEWEST_POINTS, PointView, point_information
from ..camera import Camera
from ..errors import NoiseError, OptionError, PixelsError, PointsError
from ..files import Record
from ..information.accumulate import InformationAccumulator
from ..information.fisher import FisherInformation
from ..information.symmetric import unpack
from ..information.ustatistic import pixel_products, square_root, whiten
from ..measure.measurable import Measurable
from ..measure.measurement import Measurement, measurement
from ..measure.options import MeasurementKeywords
from ..measure.tile_jacobian import TileJacobian
from ..noise import CoupledNoise, NoiseModel
from ..render.lending import in_turn
from ..se3 import Array
from .film_points import FilmPoints, film_points

HALF_WINDOW = 3
"""Windows reach this many pixels to each side, 7 x 7 by default."""

# Standard deviations of its Monte Carlo noise by which a window's tensor must exceed zero in all directions.
_RESOLVED = 4.0


@dataclass(frozen=True, eq=False)
class FeatureTracks(Record):
    """What one view offers to bundle adjustment, beside what all pixels of its image offer."""

    points: Array
    """(n, 3), in the world [scene unit]."""
    corners: Array
    """(n, 2), their images [pixel]; the first pixel's centre is at (0.5, 0.5)."""
    pixels: NDArray[np.int64]
    """(n, 2), the middle pixel of each corner's window, column and row."""
    windows: NDArray[np.bool_]
    """(H, W), the pixels of all windows, which do not overlap."""
    view: PointView
    """The camera, and every corner's covariance [pixel²]."""
    image_information: FisherInformation
    """About the camera's pose, of all pixels, from the same Jacobian as the covariances."""

    @property
    def information(self) -> FisherInformation:
        """About the camera's pose, of the corners alone, their points known."""
        return point_information(self.points, self.view)


@in_turn
def feature_tracks(
    scene: Any,
    noise: NoiseModel | None = None,
    *,
    most: int = 200,
    half_window: int = HALF_WINDOW,
    **options: Unpack[MeasurementKeywords],
) -> FeatureTracks:
    """Texture corners of a view, lifted to 3D, each with the pixel noise that its window gives it.

    Shi and Tomasi's detector finds them. Windows show one smooth, matte surface: outlines and highlights are
    no points of the scene. Of a radiance field's colours it is not known which are highlights.

    Args:
        scene: as for `pose_bound`.
        noise: of the image; None as for `pose_bound`.
        most: how many corners at most, the strongest first.
        half_window: how far windows reach to each side [pixel].
        options: see `MeasurementOptions`; all pixels are needed.

    Raises:
        PointsError: fewer than three corners.
        SensorError: the camera is no pinhole.
        NoiseError: the noise is correlated between pixels.
        OptionError, PixelsError: `most`, `half_window` or `pixels` cannot be used.
        MitsubaCRBError: as `pose_jacobian`.
    """
    if most < FEWEST_POINTS:
        raise OptionError(f"a pose needs at least {FEWEST_POINTS} corners; got most = {most}")
    with measurement(scene, **options) as run:
        behind = film_points(run.view)
        windows = _Windows.of(run, behind, noise, half_window)
        peaks = corner_peaks(
            np.where(windows.usable, corner_shi_tomasi(windows.image, sigma=half_window / 2.0), 0.0),
            min_distance=2 * half_window,
            threshold_rel=1e-3,
            num_peaks=most,
            exclude_border=half_window,
        )
        pixels = peaks.reshape(-1, 2)[:, ::-1]
        tensors, corners = windows.measure(pixels)
        # An edge's point lies anywhere along it.
        kept = np.abs(corners - pixels - 0.5).max(axis=1) < half_window
        if kept.sum() < FEWEST_POINTS:
            raise PointsError(
                f"found {kept.sum()} corners, and a pose needs at least {FEWEST_POINTS}: too little texture "
                "away from outlines, or windows too large for so few pixels (half_window, size)"
            )
        points = behind.through(corners[kept])
    centres = np.zeros(windows.usable.shape, dtype=bool)
    centres[tuple(peaks[kept].T)] = True
    return FeatureTracks(
        points=_moved(run.view.pose, points),
        corners=corners[kept],
        pixels=pixels[kept],
        windows=ndimage.binary_dilation(centres, windows.shape),
        view=windows.seen_by(run.view, tensors[kept]),
        image_information=windows.image_information,
    )


@in_turn
def see_points(
    points: ArrayLike,
    scene: Any,
    noise: NoiseModel | None = None,
    *,
    half_window: int = HALF_WINDOW,
    **options: Unpack[MeasurementKeywords],
) -> PointView:
    """How another view sees points of the scene: which of them, and how well, for `bundle_adjustment`.

    Args:
        points: (N, 3), in the world [scene unit], such as `FeatureTracks.points`.
        scene, noise, half_window, options: of the other view, as for `feature_tracks`.

    Raises:
        As `feature_tracks`; PointsError also where fewer than three of the points are seen.
    """
    world = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    with measurement(scene, **options) as run:
        behind = film_points(run.view)
        windows = _Windows.of(run, behind, noise, half_window)
        p = _moved(se3.inverse(run.view.pose), world)
        seen = np.flatnonzero(p[:, 2] > 0.0)
        film = windows.camera.project(p[seen])
        inside = ((film >= 0.0) & (film < run.view.size)).all(axis=1)
        seen, film = seen[inside], film[inside]
        pixels = np.floor(film).astype(np.int64)
        open_to_view = behind.through(film)[:, 2] >= (1.0 - behind.hidden) * p[seen, 2]
        kept = open_to_view & windows.usable[pixels[:, 1], pixels[:, 0]]
    if kept.sum() < FEWEST_POINTS:
        raise PointsError(
            f"camera {run.view.variable!r} sees {kept.sum()} of {len(world)} points, and a pose needs at "
            f"least {FEWEST_POINTS}: choose views that overlap"
        )
    tensors, _ = windows.measure(pixels[kept])
    return windows.seen_by(run.view, tensors, seen[kept])


@dataclass(frozen=True, eq=False)
class _Windows:
    """The structure tensor of a measured view, and where windows show a point of the scene."""

    camera: Camera
    image: Array
    """(H, W), grey."""
    image_information: FisherInformation
    """About the camera's pose, of all pixels."""
    half: int
    tensor: Array
    """(H, W, 2, 2), ∇I Σ⁻¹ ∇Iᵀ [1 / pixel²] without Monte Carlo bias."""
    usable: NDArray[np.bool_]
    """(H, W), centres of windows that show one smooth, matte surface and measure both directions."""

    @staticmethod
    def of(run: Measurement, behind: FilmPoints, noise: NoiseModel | None, half: int) -> _Windows:
        """Those of a view."""
        if half < 1:
            raise OptionError(f"windows reach at least 1 pixel to each side; got half_window = {half}")
        if run.selection.kind != "all":
            raise PixelsError(
                f"feature tracks need every pixel, not {run.selection.description}: leave out `pixels`"
            )
        camera = run.view.camera
        model, _ = run.noise(noise)
        if isinstance(model, CoupledNoise):
            raise NoiseError(
                "corners have covariances of their own only under noise that is independent between pixels, "
                f"not {model.description}"
            )
        height, width = run.mask.shape
        accumulator = InformationAccumulator(batches=run.options.batches, block=run.block)
        image = np.full((height, width), np.nan)
        tensor, variance = np.zeros((height, width, 2, 2)), np.zeros((height, width))
        for part, weights in run.weighted_tiles(model):
            accumulator.add(part.batch_values, weights, part.pixels, part.bias)
            x, y = part.pixels.T
            image[y, x] = part.mean.mean(axis=1)
            tensor[y, x], variance[y, x] = _structure_tensors(part, camera, weights)
        # What a window's pixels see reaches beyond it.
        reach = 2 * (half + behind.reach) + 1
        blocked = ndimage.binary_dilation(behind.unsmooth() | np.isnan(image), np.ones((reach, reach)))
        blocked[:half] = blocked[-half:] = blocked[:, :half] = blocked[:, -half:] = True
        side = 2 * half + 1
        total = ndimage.uniform_filter(tensor, side, axes=(0, 1), mode="constant")
        noise_of_total = np.sqrt(ndimage.uniform_filter(variance, side, mode="constant").clip(0.0)) / side
        usable = ~blocked & (np.linalg.eigvalsh(total)[..., 0] > _RESOLVED * noise_of_total)
        information = accumulator.information(run.linearisation)
        return _Windows(camera, np.nan_to_num(image), information, half, tensor, usable)

    @property
    def shape(self) -> NDArray[np.bool_]:
        """One window, as a mask."""
        return np.ones((2 * self.half + 1,) * 2, dtype=bool)

    def measure(self, pixels: NDArray[np.int64]) -> tuple[Array, Array]:
        """T (n, 2, 2) [1 / pixel²] and u* (n, 2) [pixel] of windows around pixels (n, 2), column and row."""
        offset = np.arange(-self.half, self.half + 1)
        positions = pixels[:, None, None] + np.stack(np.meshgrid(offset, offset), axis=-1)
        tensors = self.tensor[positions[..., 1], positions[..., 0]]
        total = tensors.sum(axis=(1, 2))
        moment = np.einsum("nyxij,nyxj->ni", tensors, positions + 0.5)
        return total, np.linalg.solve(total, moment[..., None])[..., 0]

    def seen_by(self, view: Measurable, tensors: Array, seen: NDArray[np.int64] | None = None) -> PointView:
        """The view of points whose windows have these structure tensors (n, 2, 2)."""
        return PointView(view.variable, view.pose, self.camera, np.linalg.inv(tensors), seen)


def _structure_tensors(part: TileJacobian, camera: Camera, weights: Array) -> tuple[Array, Array]:
    """∇I Σ⁻¹ ∇Iᵀ at every pixel, the mean over pairs of batches, and the variance of its noise.

    Returns:
        (n, 2, 2) [1 / pixel²], and (n,) the sum over its four entries, from the scatter between pairs.
    """
    flow = camera.flow(camera.directions(part.pixels + 0.5))[..., 3:5]
    gradients = -part.batch_values[..., 3:5] @ np.linalg.inv(flow)
    whitened = whiten(gradients, square_root(weights))
    products = pixel_products(whitened)
    xx, xy, yy = products.var(axis=0, ddof=1) / len(products)
    return unpack(products.mean(axis=0).T), xx + 2.0 * xy + yy


def _moved(a_from_b: Array, points: Array) -> Array:
    return points @ a_from_b[:3, :3].T + a_from_b[:3, 3]

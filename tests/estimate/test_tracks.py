"""Feature tracks: corners on their points, noise by another gradient, and less information than the image."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from matrices import misfit
from scipy.linalg import eigvalsh
from small_scenes import camera, scene, textured_wall, wall

from mitsuba_crb import cramer_rao_bound, fisher_information, load_scene, pose_jacobian, se3
from mitsuba_crb.agents.bundle import bundle_adjustment, point_information
from mitsuba_crb.camera import Intrinsics
from mitsuba_crb.datasets.splats import Splats
from mitsuba_crb.errors import NoiseError, OptionError, PixelsError, PointsError, SensorError
from mitsuba_crb.estimate.tracks import feature_tracks, see_points
from mitsuba_crb.noise import CoupledNoise, Gaussian
from mitsuba_crb.radiance.gaussians import Gaussians
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.view import open_view

SIGMA = Gaussian(0.01)
ROOT = Path(__file__).parents[2]
ROOM = {"size": (128, 96), "spp": 64}
SMALL = {"spp": 16, "half_window": 2}
# Half a metre to the right and turned back.
ASIDE = se3.exp([-0.5, 0.05, 0.1, 0.02, 0.12, 0.05])


@pytest.fixture(scope="module")
def room():
    """The room, and its tracks from its own camera."""
    found = load_scene(ROOT / "scenes" / "textured_room" / "textured_room.xml")
    return found, feature_tracks(found, SIGMA, **ROOM)


def mitsuba_s_image(sensor, points):
    """Film positions (n, 2) [pixel] by the sensor's own projection, zero outside the film."""
    reference = dr.zeros(mi.SurfaceInteraction3f, len(points))
    reference.p = mi.Point3f(points.T.astype(np.float32))
    sample, _ = sensor.sample_direction(reference, mi.Point2f(0.5, 0.5))
    return np.array(sample.uv).T


class TestCorners:
    @pytest.mark.slow
    def test_points_lie_on_their_corners(self, room):
        """By our own pinhole and by the sensor's projection, to float32."""
        found, tracks = room
        assert len(tracks.points) >= 15
        p = (tracks.points - tracks.view.pose[:3, 3]) @ tracks.view.pose[:3, :3]
        np.testing.assert_allclose(tracks.view.camera.project(p), tracks.corners, atol=1e-4)
        with open_view(found, size=ROOM["size"]) as view:
            image = mitsuba_s_image(view.sensor, p)
        np.testing.assert_allclose(image, tracks.corners, atol=1e-3)

    def test_points_lie_on_surfaces_that_the_camera_sees(self, room):
        found, tracks = room
        start = tracks.view.pose[:3, 3]
        reach = np.linalg.norm(tracks.points - start, axis=1)
        direction = (tracks.points - start) / reach[:, None]
        ray = mi.Ray3f(mi.Point3f(*map(float, start)), mi.Vector3f(direction.T.astype(np.float32)))
        np.testing.assert_allclose(np.array(found.ray_intersect(ray).t), reach, rtol=1e-5)

    def test_windows_do_not_overlap(self, room):
        _, tracks = room
        assert tracks.windows.sum() == len(tracks.points) * 49

    @pytest.mark.parametrize("crop", [False, True])
    def test_the_pinhole_is_mitsuba_s(self, crop):
        sensor = camera(64, 48, fov=60)
        sensor |= {"principal_point_offset_x": 0.1, "principal_point_offset_y": -0.2}
        if crop:
            sensor["film"] |= {"crop_width": 30, "crop_height": 20, "crop_offset_x": 16, "crop_offset_y": 25}
        points = np.random.default_rng(1).uniform([-0.4, -0.3, 2.0], [0.4, 0.3, 4.0], size=(20, 3))
        with open_view(textured_wall(sensor=sensor)) as view:
            image = mitsuba_s_image(view.sensor, points)
            seen = np.isfinite(image).all(axis=1) & (image > 0.0).all(axis=1)
            assert seen.sum() >= 5
            np.testing.assert_allclose(view.camera.project(points)[seen], image[seen], atol=1e-3)


class TestCovariance:
    @pytest.mark.slow
    def test_it_is_that_of_the_image_s_own_gradient(self):
        """∇I by moving the principal point instead; 256 paths leave 3 % of noise in each variance."""
        tracks = feature_tracks(textured_wall(), SIGMA, spp=256, half_window=2)
        step, images = 0.1, []
        pixels = np.argwhere(np.ones(tracks.windows.shape, dtype=bool))[:, ::-1]
        for dx, dy in ((step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step)):
            sensor = camera()
            width, height = sensor["film"]["width"], sensor["film"]["height"]
            # The film moves over the picture, not the picture over the film.
            sensor |= {"principal_point_offset_x": dx / width, "principal_point_offset_y": dy / height}
            with open_view(textured_wall(sensor=sensor)) as view:
                images.append(render_pixels(view, pixels, spp=256, seed=5)[0].reshape(height, width, 3))
        gradient = np.stack([images[0] - images[1], images[2] - images[3]], axis=-1) / (2.0 * step)
        ratios = []
        for (x, y), covariance in zip(tracks.pixels, tracks.view.noise, strict=True):
            patch = gradient[y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 2)
            expected = np.linalg.inv(patch.T @ patch) * SIGMA.sigma**2
            ratios.append(eigvalsh(covariance, expected))
        assert len(ratios) >= 8
        np.testing.assert_allclose(ratios, 1.0, atol=0.1)
        assert np.mean(ratios) == pytest.approx(1.0, abs=0.02)

    @pytest.mark.slow
    def test_it_grows_with_the_image_s_noise(self):
        one, two = (feature_tracks(textured_wall(), Gaussian(sigma), **SMALL) for sigma in (0.01, 0.02))
        np.testing.assert_allclose(two.view.noise, 4.0 * one.view.noise, rtol=1e-9)


class TestAgainstTheImage:
    @pytest.mark.slow
    def test_points_tell_less_than_the_image_and_about_what_their_windows_tell(self, room):
        """Directions in generalised eigenvalues; the windows' excess is explained in `tracks`."""
        found, tracks = room
        whole = eigvalsh(tracks.information.matrix, tracks.image_information.matrix)
        assert whole[0] > 0.01
        assert whole[-1] < 0.3
        windows = fisher_information(pose_jacobian(found, pixels=tracks.windows, **ROOM), SIGMA)
        shares = eigvalsh(tracks.information.matrix, windows.matrix)
        assert shares[0] > 0.8
        assert shares[-1] < 1.2
        # Negative control: corners measured twice as well would tell more than there is.
        sharp = dataclasses.replace(tracks.view, noise=tracks.view.noise / 4.0)
        assert eigvalsh(point_information(tracks.points, sharp).matrix, windows.matrix)[0] > 1.2

    @pytest.mark.slow
    def test_smaller_windows_are_points_more_nearly(self, room):
        """Twice the pixels, half the window's angle: an excess of 12 % becomes 2 %; 5 % with noise."""
        found, _ = room
        fine = {"size": (256, 192), "spp": 64}
        tracks = feature_tracks(found, SIGMA, **fine)
        windows = fisher_information(pose_jacobian(found, pixels=tracks.windows, **fine), SIGMA)
        shares = eigvalsh(tracks.information.matrix, windows.matrix)
        np.testing.assert_allclose(shares, 1.0, atol=0.05)
        assert eigvalsh(tracks.information.matrix, tracks.image_information.matrix)[-1] < 0.35

    @pytest.mark.slow
    def test_the_image_s_information_is_that_of_the_bound(self, room):
        found, tracks = room
        same = fisher_information(pose_jacobian(found, **ROOM), SIGMA)
        assert misfit(tracks.image_information.matrix, same.matrix) < 1e-12


class TestSeveralViews:
    def test_another_view_sees_the_points_that_nothing_hides(self, room):
        found, tracks = room
        pose = tracks.view.pose @ ASIDE
        view = see_points(tracks.points, found, SIGMA, pose=pose, **ROOM)
        assert 5 <= len(view.seen) < len(tracks.points)
        np.testing.assert_array_equal(view.pose, pose)
        for point in tracks.points[view.seen]:
            start = pose[:3, 3]
            ray = mi.Ray3f(
                mi.Point3f(*map(float, start)), mi.Vector3f(*map(float, point - start)), 0.999, 0.0, []
            )
            assert not found.ray_test(ray)[0]

    def test_two_views_know_their_relative_pose_up_to_scale(self, room):
        found, tracks = room
        other = see_points(tracks.points, found, SIGMA, pose=tracks.view.pose @ ASIDE, **ROOM)
        other = dataclasses.replace(other, variable="aside")
        graph = bundle_adjustment(tracks.points, [tracks.view, other])
        assert [(g.free, g.common) for g in graph.gauges] == [(7, 6)]
        assert cramer_rao_bound(graph.relative("camera", "aside")).rank == 5


@pytest.fixture(scope="module")
def papered():
    """A plane of splats, tilted, four pixels apart and as wide, and its tracks."""
    rng = np.random.default_rng(0)
    across, down = np.meshgrid(np.linspace(-3.0, 3.0, 56), np.linspace(-2.4, 2.4, 45))
    means = np.stack([across, down, 3.0 + 0.2 * across], axis=-1).reshape(-1, 3)
    n = len(means)
    field = Gaussians(
        Splats(
            means,
            np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            np.tile([0.08, 0.08, 0.001], (n, 1)),
            np.full(n, 0.95),
            rng.uniform(-1.0, 1.0, (n, 1, 3)),
        )
    )
    options = {"camera": Intrinsics((96, 72), (90.0, 90.0), (48.0, 36.0)), "pose": np.eye(4)}
    return field, options, feature_tracks(field, SIGMA, **options)


class TestFields:
    def test_points_lie_on_the_plane_that_the_splats_make(self, papered):
        """Expected depth is a mean over splats up to half a splat away, who lie 0.2 times that nearer."""
        _, _, tracks = papered
        assert len(tracks.points) >= 15
        plane = 3.0 + 0.2 * tracks.points[:, 0]
        np.testing.assert_allclose(tracks.points[:, 2], plane, rtol=0.006)
        np.testing.assert_allclose(tracks.view.camera.project(tracks.points), tracks.corners, atol=1e-6)

    def test_they_tell_about_what_their_windows_tell(self, papered):
        """A corner's noise is that of the field's own columns; twice as sharp corners tell too much."""
        field, options, tracks = papered
        windows = fisher_information(pose_jacobian(field, pixels=tracks.windows, **options), SIGMA)
        shares = eigvalsh(tracks.information.matrix, windows.matrix)
        assert shares[0] > 0.9
        assert shares[-1] < 1.1
        sharp = dataclasses.replace(tracks.view, noise=tracks.view.noise / 4.0)
        assert eigvalsh(point_information(tracks.points, sharp).matrix, windows.matrix)[0] > 1.3

    def test_another_view_sees_them(self, papered):
        field, options, tracks = papered
        pose = se3.exp([-0.3, 0.05, 0.0, 0.0, 0.1, 0.0])
        view = see_points(tracks.points, field, SIGMA, **options | {"pose": pose})
        assert len(view.seen) > len(tracks.points) // 2

    def test_nothing_opaque_has_no_corners(self, papered):
        field, options, _ = papered
        thin = Gaussians(dataclasses.replace(field.splats, opacities=field.splats.opacities / 20.0))
        with pytest.raises(PointsError, match="found 0 corners"):
            feature_tracks(thin, SIGMA, **options)


class TestBadInput:
    @pytest.mark.slow
    def test_too_little_texture(self):
        with pytest.raises(PointsError, match="found 0 corners"):
            feature_tracks(scene(wall=wall()), SIGMA, **SMALL)

    @pytest.mark.slow
    @pytest.mark.parametrize("point", [[0.0, 0.0, -3.0], [0.0, 9.0, 3.0], [0.0, 0.0, 5.0]])
    def test_views_that_do_not_overlap(self, point):
        """Behind the camera, outside the film, behind the wall."""
        with pytest.raises(PointsError, match="'camera' sees 0 of 4 points"):
            see_points(np.tile(point, (4, 1)), textured_wall(), SIGMA, **SMALL)

    def test_a_lens(self):
        lens = camera() | {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0}
        with pytest.raises(SensorError, match="need a pinhole, and sensor 'camera' is a ThinLensCamera"):
            feature_tracks(textured_wall(sensor=lens), SIGMA, **SMALL)

    def test_correlated_noise(self):
        class Correlated(CoupledNoise):
            description = "correlated noise"

            def check(self, *_):
                pass

            def solve(self, _pixels, values):
                return values

            def to_dict(self):
                return {}

        with pytest.raises(NoiseError, match="independent between pixels, not correlated noise"):
            feature_tracks(textured_wall(), Correlated(), **SMALL)

    def test_options(self):
        with pytest.raises(PixelsError, match=r"need every pixel, not random:0\.5"):
            feature_tracks(textured_wall(), SIGMA, pixels="random:0.5", **SMALL)
        with pytest.raises(OptionError, match="at least 3 corners; got most = 2"):
            feature_tracks(textured_wall(), SIGMA, most=2, **SMALL)
        with pytest.raises(OptionError, match="got half_window = 0"):
            feature_tracks(textured_wall(), SIGMA, half_window=0, spp=4)

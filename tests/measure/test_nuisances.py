"""Nuisance columns against finite differences of renders, what they cost, and names that cannot be one.

Ratios compare a column with its oracle by ⟨a, b⟩ / ⟨b, b⟩, with ⟨b, b⟩ over different batches, so that noise
in the oracle does not pull them below 1.
"""

from __future__ import annotations

import dataclasses
import warnings
from itertools import combinations_with_replacement, permutations
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from matrices import misfit
from one_go import measured
from small_scenes import T, camera, scene, texture, wall

from mitsuba_crb import pose_bound, pose_jacobian
from mitsuba_crb.bound.cramer_rao import ALL_NUISANCES
from mitsuba_crb.camera import LENS_MODELS, Intrinsics
from mitsuba_crb.errors import NuisanceError, NuisanceWarning, OptionError
from mitsuba_crb.export.documents import bound_document
from mitsuba_crb.information.joint import joint_information
from mitsuba_crb.jacobian import flow, forward
from mitsuba_crb.jacobian.method import Paths
from mitsuba_crb.measure.nuisances import open_nuisances
from mitsuba_crb.noise import Gaussian, PerPixel
from mitsuba_crb.render import rays
from mitsuba_crb.render.pixels import render_pixels
from mitsuba_crb.render.view import open_view

pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

SIGMA = Gaussian(0.01)
BALL = {
    "type": "sphere",
    "radius": 0.4,
    "center": [0.2, 0.1, 2.0],
    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}},
}


def _scene(**options: Any) -> dict[str, Any]:
    return scene(**{"sensor": camera(24, 16), "wall": wall(texture(cells=16)), "ball": BALL, **options})


def _ratio(ours: np.ndarray, oracle: np.ndarray) -> float:
    """Of two columns (batches, n, 3) from different random numbers."""
    square = np.mean([np.sum(oracle[k] * oracle[j]) for k, j in permutations(range(len(oracle)), 2)])
    return float(np.sum(ours.mean(axis=0) * oracle.mean(axis=0)) / square)


def _pixels() -> np.ndarray:
    x, y = np.meshgrid(np.arange(24), np.arange(16))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _rendered(value: Any, key: str, step: float, *, scale: bool = False) -> np.ndarray:
    """Central difference of renders (batches, n, 3) with a scene parameter changed by hand."""
    loaded = mi.load_dict(value)
    parameters = mi.traverse(loaded)
    kept = type(parameters[key])(parameters[key])
    images = []
    with open_view(loaded) as view:
        for sign in (1.0, -1.0):
            parameters[key] = kept * (1.0 + sign * step) if scale else kept + sign * step
            parameters.update()
            images.append(render_pixels(view, _pixels(), spp=128, seed=7, batches=4))
    return (images[0] - images[1]) / (2.0 * step)


def _sorted_columns(value: Any, names: tuple[str, ...], **options: Any) -> np.ndarray:
    """Nuisance columns (batches, n, 3, m) by rows of the image, as `_rendered` has them."""
    jacobian = pose_jacobian(value, nuisances=names, **options)
    order = np.lexsort(jacobian.pixels.T)
    return np.asarray(jacobian.batch_values[:, order, :, 6:])


class TestFilm:
    names = ("fov", "principal_point")

    @pytest.mark.slow
    @pytest.mark.parametrize("rfilter", ["gaussian", pytest.param("box", marks=pytest.mark.slow)])
    def test_columns_are_finite_differences_of_renders(self, rfilter: str) -> None:
        """Within 4 %: Monte Carlo about 1 %, and the difference's own bias of 1.5 % at 0.2 pixels."""
        sensor = camera(24, 16)
        sensor["film"]["rfilter"] = {"type": rfilter}
        value = {**_scene(), "camera": sensor}
        ours = _sorted_columns(value, self.names, spp=512)
        oracles = [
            _rendered(value, "camera.x_fov", 0.5),
            # An offset by one is the film's width; both axes point against the film's.
            -_rendered(value, "camera.principal_point_offset_x", 0.2 / 24) / 24,
            -_rendered(value, "camera.principal_point_offset_y", 0.2 / 16) / 16,
        ]
        for column, oracle in enumerate(oracles):
            assert _ratio(ours[..., column], oracle) == pytest.approx(1.0, abs=0.04), column
            # Negative control: another column.
            assert abs(_ratio(ours[..., (column + 1) % 3], oracle) - 1.0) > 0.3

    @pytest.mark.slow
    def test_other_methods_take_finite_differences_and_say_so(self) -> None:
        flow = pose_jacobian(_scene(), nuisances=self.names, spp=256)
        other = pose_jacobian(_scene(), nuisances=self.names, spp=256, method="finite_difference", seed=3)
        assert flow.provenance["nuisances"] == dict.fromkeys(self.names, "filter term")
        assert other.parameters == flow.parameters == ("fov", "principal_point", "principal_point")
        assert all(how.startswith("finite differences") for how in other.provenance["nuisances"].values())
        for column in (6, 7, 8):
            ratio = _ratio(flow.batch_values[..., column], other.batch_values[..., column])
            assert ratio == pytest.approx(1.0, abs=0.06)


OPENCV = (-0.25, 0.05, 0.01, -0.02, 0.0, 0.0, 0.0, 0.0)
LENSES = {
    "none": None,
    "opencv": Intrinsics((24, 16), (20.0, 18.0), (11.0, 9.0), "opencv", OPENCV),
    "fisheye": Intrinsics((24, 16), (17.0, 17.5), (12.5, 7.5), "fisheye", (-0.02, 0.01, -0.004, 5e-4)),
}


class TestIntrinsics:
    @pytest.mark.slow
    @pytest.mark.parametrize("lens", LENSES)
    def test_columns_are_finite_differences_of_renders(self, lens: str) -> None:
        """Within 5 %: Monte Carlo errors of 1 %, and the difference's own bias of 1 % at 0.15 pixels."""
        calibration = LENSES[lens]
        names = ("fx", "fy", "cx", "cy", *(LENS_MODELS[calibration.model] if calibration else ()))
        flow = pose_jacobian(_scene(), nuisances=names, spp=1024, camera=calibration)
        other = pose_jacobian(
            _scene(), nuisances=names, spp=1024, camera=calibration, method="finite_difference", seed=3
        )
        assert flow.provenance["nuisances"] == dict.fromkeys(names, "filter term")
        assert other.parameters == flow.parameters == names
        for column, name in enumerate(names, 6):
            ratio = _ratio(flow.batch_values[..., column], other.batch_values[..., column])
            assert ratio == pytest.approx(1.0, abs=0.05), name

    @pytest.mark.parametrize("lens", LENSES)
    def test_field_of_view_and_principal_point_are_made_of_them(self, lens: str) -> None:
        """The former scales fx and fy alike, df/f = −dα/sin α, distortion or not."""
        camera_ = LENSES[lens]
        names = ("fx", "fy", "cx", "cy", "fov", "principal_point")
        values = pose_jacobian(_scene(), nuisances=names, spp=32, camera=camera_).batch_values[..., 6:]
        fx, fy, cx, cy, fov, *point = np.moveaxis(values, -1, 0)
        np.testing.assert_array_equal([cx, cy], point)
        f = np.full(2, 12.0 / np.tan(np.radians(22.5))) if camera_ is None else np.array(camera_.focal)
        angle = 2.0 * np.arctan(12.0 / f[0])
        expected = -np.radians(1.0) / np.sin(angle) * (f[0] * fx + f[1] * fy)
        np.testing.assert_allclose(fov, expected, atol=1e-4 * np.abs(expected).max())

    @pytest.mark.slow
    def test_a_thin_lens_has_them_by_every_method(self) -> None:
        sensor = camera(24, 16) | {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.5}
        columns = [
            pose_jacobian(_scene(sensor=sensor), nuisances=("cx",), spp=512, method=method).batch_values
            for method in ("flow", "finite_difference")
        ]
        assert _ratio(*(values[..., 6] for values in columns)) == pytest.approx(1.0, abs=0.06)

    @pytest.mark.slow
    def test_a_lens_that_may_be_none_costs_what_its_coefficients_are_worth(self) -> None:
        """Coefficients that are zero and not known; those of a model that the camera has not are refused."""
        zero = Intrinsics((24, 16), (29.0, 29.0), (12.0, 8.0), "opencv", (0.0,) * 8)
        known, unknown = (
            pose_bound(_scene(), SIGMA, spp=64, camera=zero, nuisances=names) for names in ((), ("k1", "fx"))
        )
        np.testing.assert_array_equal(
            known.information.matrix, unknown.if_known[ALL_NUISANCES].information.matrix
        )
        assert (unknown.position_std > known.position_std).all()
        with pytest.raises(NuisanceError, match=r"k1 is .* opencv or fisheye, .* is a pinhole"):
            pose_bound(_scene(), SIGMA, spp=64, nuisances=("k1",))
        with pytest.raises(NuisanceError, match=r"p1 is .* model opencv, .* is a fisheye"):
            pose_bound(_scene(), SIGMA, spp=64, camera=LENSES["fisheye"], nuisances=("p1",))

    @pytest.mark.slow
    def test_a_precision_goes_on_until_every_nuisance_is_resolved(self) -> None:
        """Else the bound is one with it known; negative control: the paths that resolve the six alone."""
        zero = Intrinsics((24, 16), (29.0, 29.0), (12.0, 8.0), "opencv", (0.0,) * 8)
        names = ("k1", "k2", "k3")
        with warnings.catch_warnings():
            warnings.simplefilter("error", NuisanceWarning)
            bound = pose_bound(_scene(), SIGMA, camera=zero, nuisances=names)
            rounds = bound.provenance["sampling"]["rounds"]
            assert rounds[0]["hidden"] > 6
            assert rounds[-1]["hidden"] == 0
        enough = next(each for each in rounds if each["hidden"] <= 3)
        with pytest.warns(NuisanceWarning, match="not tell what not knowing k. costs"):
            pose_bound(_scene(), SIGMA, camera=zero, nuisances=names, spp=2 * enough["paths"] // (24 * 16))
        many = pose_bound(_scene(), SIGMA, camera=zero, nuisances=names, spp=16384, seed=9)
        for found, truth in zip(
            (bound.position_std, bound.rotation_std_deg),
            (many.position_std, many.rotation_std_deg),
            strict=True,
        ):
            np.testing.assert_allclose(found, truth, rtol=0.06)


class TestLevels:
    @pytest.mark.parametrize("method", ["finite_difference", "flow"])
    def test_gain_is_each_batchs_own_image_and_black_a_constant(self, method: str) -> None:
        jacobian = pose_jacobian(_scene(), nuisances=("gain", "black"), spp=64, method=method)
        gain, black = np.moveaxis(jacobian.batch_values[..., 6:], -1, 0)
        assert (black == 1.0).all()
        if method == "finite_difference":
            np.testing.assert_allclose(gain.mean(axis=0), jacobian.mean, rtol=1e-12)
        else:  # whose image, to be shown, is not the mean of its batches' unbiased ones
            slope = np.sum(gain.mean(axis=0) * jacobian.mean) / np.sum(jacobian.mean**2)
            assert slope == pytest.approx(1.0, abs=0.01)
        assert not np.allclose(gain[0], gain[1], rtol=1e-3)  # not lent from batch to batch


class TestSceneParameters:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        "name",
        [
            "light.radiance.value:scale",
            pytest.param("wall.bsdf.reflectance.data:scale", marks=pytest.mark.slow),
            pytest.param("lamp.intensity.value", marks=pytest.mark.slow),
        ],
    )
    def test_columns_are_finite_differences_of_renders(self, name: str) -> None:
        """Within 3 %: the image is linear in all of them, and Monte Carlo errors are below 1 %."""
        lamp = {"type": "point", "position": [0.5, 0.5, 0.0], "intensity": {"type": "uniform", "value": 2.0}}
        value = _scene(lamp=lamp)
        jacobian = pose_jacobian(value, nuisances=(name,), spp=256)
        assert jacobian.provenance["nuisances"] == {name: "forward mode"}
        ours = jacobian.batch_values[..., 6][:, np.lexsort(jacobian.pixels.T)]
        key = name.removesuffix(":scale")
        oracle = _rendered(value, key, 0.05, scale=key != name)
        assert _ratio(ours, oracle) == pytest.approx(1.0, abs=0.03)
        assert abs(_ratio(ours, 2.0 * oracle) - 1.0) > 0.3  # negative control

    @pytest.mark.slow
    def test_python_integrators_and_what_moves_edges_take_finite_differences(self) -> None:
        """The ball's shift along x, within 6 % of moving its centre by hand."""
        names = ("ball.to_world", "ball.bsdf.reflectance.value")
        with open_view(_scene(), integrator={"type": "prb", "max_depth": 2}) as view:
            moved, painted = open_nuisances(view, names, "flow")
        assert (moved.width, painted.width) == (6, 3)
        assert moved.how.startswith("finite differences")
        assert painted.how == "finite differences, step 0.002, 0.005, 0.007"
        jacobian = pose_jacobian(_scene(), nuisances=names[:1], spp=1024)
        shift = jacobian.batch_values[..., 6][:, np.lexsort(jacobian.pixels.T)]
        images = []
        for x in (0.21, 0.19):
            with open_view(_scene(ball={**BALL, "center": [x, 0.1, 2.0]})) as view:
                images.append(render_pixels(view, _pixels(), spp=512, seed=7, batches=4))
        assert _ratio(shift, (images[0] - images[1]) / 0.02) == pytest.approx(1.0, abs=0.06)


class TestRandomNumbers:
    """A U-statistic needs batches of different numbers in every pair of columns, whatever measures them."""

    seeds = 12

    def _measured(self) -> dict[str, np.ndarray]:
        """The image (seeds, batches, n, 3) at eight paths, as each kernel that draws paths measures it."""
        paths = {"spp": 8, "batches": 4}
        found: dict[str, list[np.ndarray]] = {"renders": [], "flow": [], "forward mode": []}
        with open_view(_scene()) as view:
            (lamp,) = open_nuisances(view, ("light.radiance.value:scale",), flow.Flow)
            for seed in range(self.seeds):
                image = render_pixels(view, _pixels(), spp=2, batches=4, seed=seed)
                found["renders"].append(image)
                found["flow"].append(measured(flow.Flow, view, _pixels(), seed=seed, **paths)[1])
                # The image is linear in its only light.
                found["forward mode"].append(
                    lamp.columns(view, _pixels(), image, image, Paths(seed=seed, **paths))[0][..., 0]
                )
            _, image = measured(forward.Forward, view, _pixels(), seed=0, **paths)
        np.testing.assert_allclose(image, found["forward mode"][0], rtol=1e-4)
        return {name: np.array(values) for name, values in found.items()}

    def _coupling(self, a: np.ndarray, b: np.ndarray) -> float:
        """Mean product of two kernels' errors in different batches of a seed, in standard errors.

        The same product with the next seed's batches, which has the expectation 0, is taken off.
        """
        errors, others = a - a.mean(axis=(0, 1)), b - np.roll(b, 1, axis=0)
        products = np.einsum("skni,slni->skl", errors, others)
        products[:, range(4), range(4)] = 0.0
        each = products.sum(axis=(1, 2))
        return float(each.mean() / (each.std(ddof=1) / np.sqrt(self.seeds)))

    @pytest.mark.slow
    def test_different_batches_of_any_two_kernels_are_independent(self) -> None:
        """Within 4 standard errors; the same batches in other places are the negative control, at 10."""
        measured = self._measured()
        for a, b in combinations_with_replacement(measured.values(), 2):
            assert abs(self._coupling(a, b)) < 4.0
        renders = measured["renders"]
        assert self._coupling(renders, np.roll(renders, 1, axis=1)) > 10.0


class TestCost:
    @pytest.mark.slow
    def test_adding_a_nuisance_never_improves_a_bound_and_fixing_it_undoes_that(self) -> None:
        plain = pose_bound(_scene(), SIGMA, spp=64)
        one = pose_bound(_scene(), SIGMA, spp=64, nuisances=("gain",))
        three = pose_bound(_scene(), SIGMA, spp=64, nuisances=("gain", "black:16", "fov"))
        for less, more in ((plain, one), (one, three)):
            ratio = np.concatenate(
                [more.position_std / less.position_std, more.rotation_std_deg / less.rotation_std_deg]
            )
            assert (ratio >= 1.0 - 1e-9).all()
        assert (three.position_std > 1.01 * plain.position_std).any()
        assert three.joint is not None
        undone = three.joint.fix("gain", "black:16", "fov").information
        assert misfit(undone.matrix, plain.information.matrix) < 1e-9
        assert set(three.if_known) == {"gain", "black:16", "fov", ALL_NUISANCES}
        known = three.if_known[ALL_NUISANCES]
        np.testing.assert_allclose(known.position_std, plain.position_std, rtol=1e-6)
        written = bound_document(three)["nuisances"]
        assert written["how"] == {"gain": "the image itself", "black:16": "exact", "fov": "filter term"}
        assert written["joint"]["parameters"] == ["gain", "fov"]

    def test_what_the_image_does_not_see_is_a_warning_and_costs_nothing(self) -> None:
        behind = {"type": "cube", "to_world": T().translate([0, 0, -99]).scale(0.01)}
        name = "behind.bsdf.reflectance.value"
        with pytest.warns(
            NuisanceWarning, match=f"does not see {name}, so that not knowing it costs nothing"
        ):
            bound = pose_bound(_scene(behind=behind), SIGMA, spp=16, nuisances=(name,))
        plain = pose_bound(_scene(behind=behind), SIGMA, spp=16)
        np.testing.assert_allclose(bound.position_std, plain.position_std, rtol=1e-6)
        with warnings.catch_warnings():
            warnings.simplefilter("error", NuisanceWarning)
            pose_bound(_scene(behind=behind), SIGMA, spp=16, nuisances=("gain",))

    @pytest.mark.slow
    @pytest.mark.parametrize("names", [("gain:8",), ("gain:8", "black:8", "fov")])
    def test_a_tile_that_noise_hides_is_a_tile_left_out(self, names: tuple[str, ...]) -> None:
        variance = np.full((16, 24), 1e-4)
        variance[:8, 8:16] = np.inf
        hidden = pose_bound(_scene(), PerPixel(variance), spp=16, nuisances=names)
        out = pose_bound(_scene(), SIGMA, spp=16, nuisances=names, pixels=np.isfinite(variance))
        whole = pose_bound(_scene(), SIGMA, spp=16, nuisances=names)
        scale = np.sqrt(np.diagonal(out.information.matrix))
        difference = (hidden.information.matrix - out.information.matrix) / np.outer(scale, scale)
        assert np.abs(difference).max() < 1e-9
        assert (np.diagonal(whole.information.matrix) > 1.01 * np.diagonal(out.information.matrix)).all()

    @pytest.mark.slow
    def test_the_scene_is_as_before(self) -> None:
        loaded = mi.load_dict(_scene())
        names = ("ball.to_world", "ball.bsdf.reflectance.value", "wall.bsdf.reflectance.data:scale")
        first = pose_jacobian(loaded, nuisances=names, spp=16)
        again = pose_jacobian(loaded, nuisances=names, spp=16)
        assert first.parameters == (names[0],) * 6 + (names[1],) * 3 + (names[2],)
        np.testing.assert_array_equal(first.batch_values, again.batch_values)
        before = pose_jacobian(_scene(), spp=16)
        np.testing.assert_array_equal(first.batch_values[..., :6], before.batch_values)


class TestRandomPixels:
    names = ("gain:8", "fov")

    @pytest.mark.parametrize("run", [pose_bound, pose_jacobian])
    def test_a_nuisance_per_tile_is_refused_before_anything_is_rendered(
        self, run: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def render(*_: Any) -> None:
            raise AssertionError("rendered")

        monkeypatch.setattr(rays, "camera_ray", render)
        with pytest.raises(OptionError, match="gain:8 with random:f pixels"):
            run(_scene(), nuisances=self.names, pixels="random:0.5")
        with pytest.raises(AssertionError, match="rendered"):  # negative control
            run(_scene(), nuisances=self.names, pixels="random:1")

    @pytest.mark.slow
    def test_other_subsets_and_other_nuisances_are_measured(self) -> None:
        for names, chosen in (
            (self.names, "random:1"),
            (self.names, "gradient:0.5"),
            (self.names, np.arange(384).reshape(16, 24) % 2 == 0),
            (("gain",), "random:0.5"),
        ):
            assert pose_bound(_scene(), SIGMA, spp=16, nuisances=names, pixels=chosen).joint is not None

    def test_a_random_jacobian_s_columns_are_no_nuisance_per_tile(self) -> None:
        jacobian = pose_jacobian(_scene(), spp=16, nuisances=("gain",), pixels="random:0.5")
        with pytest.raises(OptionError, match="gain:8 with random:f pixels"):
            joint_information(dataclasses.replace(jacobian, parameters=("gain:8",)), SIGMA)


class TestBadNames:
    @pytest.mark.parametrize(
        ("names", "message"),
        [
            (["gian"], "no nuisance or scene parameter is named gian; near ones: gain"),
            (["ball.bsdf.reflectance"], "near ones: ball.bsdf.reflectance.value"),
            (
                ["qqqqqqqq"],
                "there are: gain, black, fov, principal_point, fx, fy, cx, cy, light.radiance.value",
            ),
            (["fov:16"], "no nuisance or scene parameter is named fov:16"),
            (["camera.x_fov"], "no derivative in camera.x_fov; use the nuisance fov"),
            (["camera.film.size"], "Mitsuba has no derivative in camera.film.size"),
            (
                ["wall.bsdf.reflectance.data"],
                "has 768 entries, .* wall.bsdf.reflectance.data:scale is a common",
            ),
            (["ball.to_world:scale"], "its six motions have no common scale"),
            (["gain", "fov", "gain"], "nuisance gain was given twice"),
            (["gain:20"], "multiple of 8, not 20"),
            ("gain", "a sequence of names"),
        ],
    )
    def test_they_are_named_with_near_ones(self, names: Any, message: str) -> None:
        with pytest.raises(NuisanceError, match=message):
            pose_bound(_scene(), SIGMA, nuisances=names)

"""A hash grid's image and derivative: beside Dr.Jit's interpolation, differences and shifted pixels."""

from __future__ import annotations

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from mitsuba_crb import se3
from mitsuba_crb.camera import Camera
from mitsuba_crb.errors import FieldError
from mitsuba_crb.radiance import interpolation, march
from mitsuba_crb.radiance.field import ORDERS
from mitsuba_crb.radiance.hashgrid import HashGrid
from mitsuba_crb.radiance.network import Design, Network, new_weights
from mitsuba_crb.radiance.occupancy import bytes_of, everywhere
from mitsuba_crb.radiance.scene_space import SceneSpace, contracted, expanded, pulled
from mitsuba_crb.render.arrays import upload
from mitsuba_crb.render.backend import use_mitsuba

use_mitsuba()

Floats = NDArray[np.float64]

DESIGN = Design(levels=4, features=2, coarsest=4, finest=24, table=2**10, hidden=16, cells=16, steps=40)
CAMERA = Camera.pinhole(30.0, (12.0, 10.0), (24, 20))
POSE = se3.exp([0.3, -0.2, -2.1, 0.1, 0.2, -0.3])


def made(design: Design = DESIGN, seed: int = 3, *, holes: bool = True) -> HashGrid:
    """A field of random numbers: cloudy, coloured, with empty cells."""
    rng = np.random.default_rng(seed)
    count = design.encoding(0).n_params
    weights = new_weights(design, seed)
    weights["w2"][0] *= 3.0
    vertices = everywhere(design.cells)
    if holes:
        vertices &= rng.random(vertices.shape) < 0.7
    entries = rng.normal(size=count).astype(np.float32)
    space = SceneSpace((0.2, -0.1, 0.4), 2.5)
    return HashGrid("made", design, space, entries, weights, vertices, (0.1, 0.5, 0.9))


FIELD = made()
PIXELS = np.stack(np.meshgrid(np.arange(24), np.arange(20)), axis=-1).reshape(-1, 2)


def vectors(points: Floats) -> mi.Vector3f:
    return mi.Vector3f(*(upload(mi.Float, points[:, k]) for k in range(3)))


class TestParts:
    def test_features_are_those_of_drjit_and_slopes_those_of_automatic_differentiation(self) -> None:
        encoding = DESIGN.encoding(1)
        network = Network(DESIGN, encoding, new_weights(DESIGN, 1))
        u = vectors(np.random.default_rng(0).random((64, 3)))
        features, along = interpolation.encode(encoding, u, slopes=True)
        dr.enable_grad(u)
        theirs = list(encoding(u))
        np.testing.assert_allclose(np.array(features), np.array(theirs), rtol=1e-6, atol=1e-10)
        for k, feature in enumerate(theirs):
            dr.backward(feature, flags=dr.ADFlag.ClearInterior)
            for axis in range(3):
                want = np.array(dr.grad(u)[axis])
                np.testing.assert_allclose(np.array(along[axis][k]), want, rtol=1e-4, atol=1e-8)
            dr.set_grad(u, 0.0)
        assert network.weights()["w1"].shape == (16, 8)

    def test_weights_come_back_as_they_were(self) -> None:
        weights = new_weights(DESIGN, 5)
        for turned in (False, True):
            found = Network(DESIGN, DESIGN.encoding(1), weights, turned=turned).weights()
            for name in weights:
                np.testing.assert_array_equal(found[name], weights[name])

    def test_space_is_contracted_into_the_cube_and_expanded_again(self) -> None:
        z = np.random.default_rng(0).normal(size=(200, 3)) * np.geomspace(0.1, 20.0, 200)[:, None]
        u = np.array(contracted(vectors(z))).T
        assert u.min() > 0.0
        assert u.max() < 1.0
        np.testing.assert_allclose(expanded(u.astype(np.float64)), z, rtol=2e-3)

    def test_gradients_are_pulled_back_through_the_contraction(self) -> None:
        rng = np.random.default_rng(0)
        z, slope = rng.normal(size=(50, 3)) * 2.0, rng.normal(size=(50, 3))
        found = np.array(pulled(vectors(z), vectors(slope))).T

        def u(at: Floats) -> Floats:
            r = np.maximum(np.linalg.norm(at, axis=1, keepdims=True), 1.0)
            return (2.0 - 1.0 / r) / r * at / 4.0 + 0.5

        for axis in range(3):
            step = 1e-6 * np.eye(3)[axis]
            want = ((u(z + step) - u(z - step)) / 2e-6 * slope).sum(axis=1)
            np.testing.assert_allclose(found[:, axis], want, rtol=1e-4, atol=1e-6)

    def test_the_centre_is_what_cameras_look_at(self) -> None:
        target = np.array([1.0, 2.0, 3.0])
        poses = np.array([np.eye(4)] * 3)
        for k, axis in enumerate(np.eye(3)):
            poses[k, :3, :3] = np.roll(np.eye(3), 2 - k, axis=1)
            assert np.array_equal(poses[k, :3, 2], axis)
            poses[k, :3, 3] = target - 4.0 * axis
        space = SceneSpace.around(poses)
        np.testing.assert_allclose(space.centre, target, atol=0.01)
        assert space.scale == pytest.approx(4.0, rel=0.01)
        assert SceneSpace.around(poses[:1] * np.ones((4, 1, 1))).scale > 0.0

    def test_a_cell_knows_its_corners(self) -> None:
        vertices = np.zeros((3, 3, 3), dtype=np.bool_)
        vertices[1, 0, 2] = True  # z, y, x
        found = bytes_of(vertices).reshape(2, 2, 2)
        # Of the cell at x = 1, y = 0, z = 0 it is the corner (1, 0, 1).
        assert found[0, 0, 1] == 1 << 5
        assert found[1, 0, 1] == 1 << 1
        assert np.count_nonzero(found) == 2


class TestImage:
    def test_equal_calls_and_subsets_give_equal_bits(self) -> None:
        whole = FIELD.show(CAMERA, POSE, PIXELS)
        some = np.random.default_rng(0).permutation(len(PIXELS))[:77]
        part = FIELD.show(CAMERA, POSE, PIXELS[some])
        np.testing.assert_array_equal(whole.values[some], part.values)
        np.testing.assert_array_equal(whole.depth[some], part.depth)
        one = FIELD.columns(CAMERA, POSE, PIXELS[:1])
        many = FIELD.columns(CAMERA, POSE, PIXELS)
        np.testing.assert_array_equal(one[1], many[1][:1])
        np.testing.assert_array_equal(FIELD.columns(CAMERA, POSE, PIXELS)[1], many[1])

    def test_the_values_of_columns_are_those_shown(self) -> None:
        values, columns = FIELD.columns(CAMERA, POSE, PIXELS)
        np.testing.assert_allclose(values, FIELD.show(CAMERA, POSE, PIXELS).values, atol=1e-6)
        assert columns.shape == (len(PIXELS), 3, 6)

    def test_both_orders_of_summation_are_the_same_but_for_rounding(self) -> None:
        first, second = (FIELD.show(CAMERA, POSE, PIXELS, order=order).values for order in range(ORDERS))
        assert 0.0 < np.abs(first - second).max() < 1e-4
        a, b = (FIELD.columns(CAMERA, POSE, PIXELS, order=order)[1] for order in range(ORDERS))
        assert 0.0 < np.abs(a - b).max() < 1e-3 * np.abs(a).max()

    def test_an_empty_field_is_its_background(self) -> None:
        nothing = dataclasses.replace(FIELD, vertices=np.zeros_like(FIELD.vertices))
        shown = nothing.show(CAMERA, POSE, PIXELS)
        np.testing.assert_allclose(
            shown.values, np.broadcast_to((0.1, 0.5, 0.9), shown.values.shape), atol=1e-6
        )
        assert np.isnan(shown.depth).all()
        assert (shown.opacity == 0.0).all()
        assert not nothing.columns(CAMERA, POSE, PIXELS)[1].any()

    def test_opacity_and_depth_are_those_of_the_sum(self) -> None:
        shown = FIELD.show(CAMERA, POSE, PIXELS)
        black = dataclasses.replace(FIELD, background=(0.0, 0.0, 0.0)).show(CAMERA, POSE, PIXELS)
        behind = (1.0 - shown.opacity)[:, None] * np.array((0.1, 0.5, 0.9))
        np.testing.assert_allclose(shown.values, black.values + behind, atol=1e-5)
        seen = ~np.isnan(shown.depth)
        assert seen.any()
        assert (shown.depth[seen] > 0.0).all()

    def test_a_camera_with_an_aperture_is_refused(self) -> None:
        with pytest.raises(FieldError, match="aperture"):
            FIELD.refuse(dataclasses.replace(CAMERA, radius=0.1))

    def test_no_pixels_are_no_values(self) -> None:
        nobody = np.zeros((0, 2), dtype=np.int64)
        assert FIELD.show(CAMERA, POSE, nobody).values.shape == (0, 3)
        assert FIELD.columns(CAMERA, POSE, nobody)[1].shape == (0, 3, 6)


def slope(found: Floats, wanted: Floats) -> float:
    """Of the line through the origin that fits `wanted` by `found`."""
    return float((found * wanted).sum() / (found * found).sum())


def differences(field: HashGrid, step: Floats) -> Floats:
    """(n, 3, 6) central differences of the image."""
    sides = []
    for k in range(6):
        twist = np.zeros(6)
        twist[k] = step[k]
        ahead, back = (field.show(CAMERA, POSE @ se3.exp(s * twist), PIXELS).values for s in (1.0, -1.0))
        sides.append((ahead - back) / (2.0 * step[k]))
    return np.stack(sides, axis=-1)


class TestColumns:
    def test_each_is_the_difference_of_images(self) -> None:
        columns = FIELD.columns(CAMERA, POSE, PIXELS)[1]
        wanted = differences(FIELD, np.array([2e-3] * 3 + [1e-3] * 3))
        for k in range(6):
            assert slope(columns[..., k], wanted[..., k]) == pytest.approx(1.0, abs=0.01)
            assert np.corrcoef(columns[..., k].ravel(), wanted[..., k].ravel())[0, 1] > 0.999

    def test_without_the_slope_of_the_window_they_are_not(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The negative control: what a derivative sees that knows nothing of cells that come and go."""

        def blind(byte: mi.UInt32, f: mi.Vector3f) -> tuple[mi.Float, mi.Vector3f]:
            return interpolation.window(byte, f)[0], mi.Vector3f(0.0)

        monkeypatch.setattr(march, "window", blind)
        columns = FIELD.columns(CAMERA, POSE, PIXELS)[1]
        wanted = differences(FIELD, np.array([2e-3] * 3 + [1e-3] * 3))
        assert max(abs(slope(columns[..., k], wanted[..., k]) - 1.0) for k in range(6)) > 0.05

    def test_those_of_rotation_are_the_flow_of_the_image_along_the_film(self) -> None:
        """∂I/∂φ = −∇I · f, with f the flow of points at infinity: nothing of the field enters."""
        columns = FIELD.columns(CAMERA, POSE, PIXELS)[1]
        film, step = PIXELS + 0.5, 0.02
        gradient = np.stack(
            [
                (
                    FIELD.at(CAMERA, POSE, film + step * axis).values
                    - FIELD.at(CAMERA, POSE, film - step * axis).values
                )
                / (2.0 * step)
                for axis in np.eye(2)
            ],
            axis=-1,
        )
        flow = CAMERA.flow(CAMERA.directions(film))[:, :, 3:]
        wanted = -np.einsum("ncf,nfk->nck", gradient, flow)
        for k in range(3):
            assert slope(columns[..., 3 + k], wanted[..., k]) == pytest.approx(1.0, abs=0.01)

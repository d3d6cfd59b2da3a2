"""What numbers are about: what is refused, what two measurements together are about, both frames."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from rigs import about, made, random_pose

from mitsuba_crb import se3
from mitsuba_crb.agents.tiles import TileInformation
from mitsuba_crb.errors import FrameError, PoseError
from mitsuba_crb.information.image_jacobian import ImageJacobian
from mitsuba_crb.information.joint import JointAccumulator
from mitsuba_crb.information.linearisation import Linearised, PixelSelection

POSE = random_pose(np.random.default_rng(1))


class TestFields:
    @pytest.mark.parametrize(
        ("changes", "error", "message"),
        [
            ({"frame": "body"}, FrameError, "unknown frame 'body'; expected 'camera' or 'world'"),
            ({"length_scale": 0.0}, FrameError, "length scale must be positive and finite, not 0.0"),
            ({"length_scale": -1.0}, FrameError, "positive and finite, not -1.0"),
            ({"length_scale": np.nan}, FrameError, "positive and finite, not nan"),
            ({"length_scale": np.inf}, FrameError, "positive and finite, not inf"),
            ({"pose": np.eye(3)}, PoseError, r"must have shape \(4, 4\), not \(3, 3\)"),
            ({"pose": np.full((4, 4), np.nan)}, PoseError, "NaN or infinite"),
            ({"pose": np.diag([2.0, 2.0, 2.0, 1.0])}, PoseError, "a scale"),
        ],
    )
    def test_what_is_malformed_is_named(self, changes, error, message):
        with pytest.raises(error, match=message):
            about(**changes)

    def test_the_pose_is_a_copy_that_nobody_can_change(self):
        given = POSE.copy()
        made_of_it = about(pose=given)
        given[0, 3] += 1.0
        np.testing.assert_array_equal(made_of_it.pose, POSE)
        with pytest.raises(ValueError, match="read-only"):
            made_of_it.pose[0, 3] = 1.0

    def test_a_rigid_pose_keeps_its_bits_however_often_it_is_said(self):
        again = about(pose=POSE)
        for frame in ("world", "camera", "world"):
            again = dataclasses.replace(again, frame=frame)
        np.testing.assert_array_equal(again.pose, POSE)

    def test_scale_turns_scaled_units_into_scene_units(self):
        assert about(length_scale=3.0).scale.tolist() == [3.0, 3.0, 3.0, 1.0, 1.0, 1.0]


class TestFrames:
    @pytest.mark.parametrize(("old", "new"), [("camera", "world"), ("world", "camera")])
    def test_a_twist_in_either_frame_is_the_same_motion(self, old, new):
        """exp(ξ) on the left, or on the right, of one pose."""
        moved = {
            "camera": lambda xi: POSE @ se3.exp(xi),
            "world": lambda xi: se3.exp(xi) @ POSE,
        }
        xi = np.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.3])
        A = about(frame=old, pose=POSE).old_from_new(new)
        np.testing.assert_allclose(moved[old](A @ xi), moved[new](xi), atol=1e-13)
        # Negative control: the way back is another one.
        assert np.abs(moved[old](np.linalg.inv(A) @ xi) - moved[new](xi)).max() > 1e-2

    @pytest.mark.parametrize("frame", ["camera", "world"])
    def test_its_own_frame_needs_no_change(self, frame):
        assert about(frame=frame).old_from_new(frame) is None

    def test_an_unknown_frame_is_refused(self):
        with pytest.raises(FrameError, match="unknown frame 'rig'; expected 'camera' or 'world'"):
            about().old_from_new("rig")


class TestMixing:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"variable": "other"}, "cannot weigh about 'camera' and about 'other'; transport them"),
            ({"frame": "world"}, "cannot weigh in the camera and in the world frame; call to_frame"),
            (
                {"pose": POSE @ se3.exp([0, 0, 0, 0, 0, 1e-6])},
                "cannot weigh linearised at two",
            ),
        ],
    )
    def test_what_differs_is_named_whichever_comes_first(self, changes, message):
        a, b = about(pose=POSE), about(**({"pose": POSE} | changes))
        with pytest.raises(FrameError, match=message):
            a.refuse_to_mix(b, "weigh")
        with pytest.raises(FrameError, match="cannot weigh"):
            b.refuse_to_mix(a, "weigh")

    def test_rounding_at_the_size_of_the_position_may_be_mixed(self):
        far = POSE.copy()
        far[:3, 3] += 1e6
        for pose, within, beyond in ((POSE, 1e-10, 1e-7), (far, 1e-4, 1e-1)):
            off, further = pose.copy(), pose.copy()
            off[0, 3] += within
            further[0, 3] += beyond
            about(pose=pose).refuse_to_mix(about(pose=off), "add")
            with pytest.raises(FrameError):
                about(pose=pose).refuse_to_mix(about(pose=further), "add")

    def test_unit_and_pixels_may_differ_and_both_count(self):
        a = about(length_scale=2.0, selection=PixelSelection("all", 100, 100, "all"))
        b = about(length_scale=5.0, selection=PixelSelection("random", 40, 10, "random:0.25"))
        a.refuse_to_mix(b, "add")
        both = a.with_pixels_of(b)
        assert both.length_scale == b.with_pixels_of(a).length_scale == 5.0
        assert both.selection == PixelSelection("random", 140, 110, "all + random:0.25")
        assert (both.variable, both.frame) == (a.variable, a.frame)

    @pytest.mark.parametrize(
        ("kinds", "expected"),
        [
            (("all", "all"), "all"),
            (("all", "random"), "random"),
            (("only", "random"), "only"),
            (("all", "only"), "only"),
        ],
    )
    def test_two_selections_are_of_the_kind_that_promises_less(self, kinds, expected):
        a, b = (PixelSelection(kind, 4, 2, kind) for kind in kinds)
        assert (a + b).kind == (b + a).kind == expected


class TestWhatCarriesIt:
    def test_its_fields_are_read_and_said_anew(self):
        information = made(np.eye(6), pose=POSE)
        assert isinstance(information, Linearised)
        for name in ("variable", "frame", "pose", "length_scale", "selection"):
            assert getattr(information, name) is getattr(information.linearisation, name)
        other = information.about(variable="other", frame="world")
        assert (other.variable, other.frame) == ("other", "world")
        assert (information.variable, information.frame) == ("camera", "camera")
        np.testing.assert_array_equal(other.matrix, information.matrix)
        with pytest.raises(TypeError, match="sensor"):
            information.about(sensor="other")

    def test_a_matrix_said_to_be_in_another_frame_forgets_where_it_came_from(self):
        world = made(np.diag([1.0, 2, 3, 4, 5, 6]), pose=POSE).to_frame("world")
        turned = world.about(pose=np.eye(4)).to_frame("camera")
        np.testing.assert_array_equal(turned.matrix, world.matrix)

    def test_joint_information_and_tiles_are_in_the_camera_frame_only(self):
        rng = np.random.default_rng(2)
        accumulator = JointAccumulator((), batches=4)
        pixels = np.stack([np.arange(9), np.zeros(9, int)], axis=1)
        accumulator.add(rng.normal(size=(4, 9, 3, 6)), np.ones((9, 3)), pixels)
        with pytest.raises(FrameError, match="in the camera frame; call to_frame on the Jacobian"):
            accumulator.information(about(frame="world"))
        block = np.eye(6)[None]
        with pytest.raises(FrameError, match="agent 'a': tiles are in the camera frame"):
            TileInformation(
                "a", [[0, 0, 8, 8]], block, block, [100], linearisation=about(variable="body", frame="world")
            )


class TestPixelsOfAJacobian:
    def _jacobian(self, kind="random"):
        rng = np.random.default_rng(3)
        pixels = np.stack(np.divmod(rng.permutation(24)[:12], 4)[::-1], axis=1)
        selection = PixelSelection(kind, 24, 12, f"{kind}:0.5")
        return ImageJacobian(
            rng.normal(size=(4, 12, 1, 6)),
            pixels,
            rng.normal(size=(6, 4, 1)),
            linearisation=about(selection=selection),
            provenance={"pixels": vars(selection).copy()},
        )

    def test_a_mask_and_a_list_choose_alike(self):
        """The same pixels, in the Jacobian's order and row by row, and the same word on what they are."""
        jacobian = self._jacobian()
        mask = np.zeros((6, 4), dtype=bool)
        mask[:3] = True
        masked = jacobian.only(mask)
        listed = jacobian.at(np.stack(np.nonzero(mask)[::-1], axis=1))
        order = np.lexsort(masked.pixels.T)
        assert 0 < len(order) < 12
        np.testing.assert_array_equal(masked.pixels[order], listed.pixels)
        np.testing.assert_array_equal(masked.batch_values[:, order], listed.batch_values)
        expected = PixelSelection("only", 24, len(order), "random:0.5")
        assert masked.selection == listed.selection == expected
        assert masked.provenance == listed.provenance == {"pixels": vars(expected)}

    def test_only_a_list_that_drops_none_still_stands_for_the_whole_image(self):
        jacobian = self._jacobian()
        assert jacobian.at(jacobian.pixels).selection == jacobian.selection
        assert jacobian.only(np.ones((6, 4), dtype=bool)).selection.kind == "only"

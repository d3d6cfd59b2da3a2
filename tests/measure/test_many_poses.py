"""Bounds of many poses: each is the one that it would be alone, and a run that was interrupted goes on."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import T, camera, scene, texture, wall

from mitsuba_crb import pose_bound, pose_bounds, se3
from mitsuba_crb.bound.cramer_rao import PoseBound
from mitsuba_crb.camera import Intrinsics
from mitsuba_crb.errors import (
    CameraError,
    NoiseError,
    OptionError,
    PoseError,
    PrecisionError,
    SaturatedError,
    SceneWarning,
)
from mitsuba_crb.export.pose_files import PoseFiles
from mitsuba_crb.measure.pose_table import PoseRow, PoseTable
from mitsuba_crb.measure.poses import pose_table
from mitsuba_crb.noise import Gaussian

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

FEW: dict[str, Any] = {"size": (24, 18), "spp": 16}
BOX = {"type": "cube", "to_world": T().translate([3.0, 0, 1.0]).scale(0.4)}
WORLD = scene(wall=wall(texture()), box=BOX, sensor=camera())

PATH = [se3.exp([0.2 * k, 0.1 * k, 0.3 * k, 0.02 * k, -0.03 * k, 0.1 * k]) for k in range(3)]
AWAY = se3.exp([0, 0, 0, 0, np.pi, 0])
INSIDE = se3.exp([3.0, 0, 1.0, 0, 0, 0])


def same(one: PoseBound, other: PoseBound) -> bool:
    """Bit for bit, but for how long it took."""
    documents = []
    for bound in (one, other):
        document = bound.to_dict()
        for name in ("seconds", "scene"):
            document["provenance"].pop(name)
        documents.append(json.dumps(document))
    return documents[0] == documents[1]


@pytest.mark.slow
@pytest.mark.parametrize("options", [FEW, {"size": (24, 18), "precision": 0.1}], ids=["spp", "precision"])
def test_each_bound_is_that_of_its_pose_alone(options: dict[str, Any]) -> None:
    found = pose_bounds(WORLD, PATH, **options)
    white = found[0].provenance["noise"]["white"]
    for pose, bound in zip(PATH, found, strict=True):
        assert same(bound, pose_bound(WORLD, pose=pose, exposure=white, **options))


@pytest.mark.slow
def test_a_calibration_takes_the_sensor_s_place_at_every_pose() -> None:
    lens = Intrinsics((24, 18), (25.0, 26.0), (11.5, 9.25), "opencv", (-0.1, 0, 0, 0, 0, 0, 0, 0))
    options: dict[str, Any] = {"spp": 16, "camera": lens}
    found = pose_bounds(WORLD, PATH[:2], Gaussian(0.02), **options)
    for pose, bound in zip(PATH, found, strict=False):
        assert same(bound, pose_bound(WORLD, Gaussian(0.02), pose=pose, **options))
    other = dataclasses.replace(lens, distortion=(-0.2, *lens.distortion[1:]))
    one, two = (pose_table(WORLD, PATH[:1], spp=16, camera=each).settings["camera"] for each in (lens, other))
    assert one != two


def test_each_pose_may_have_a_camera_of_its_own() -> None:
    bent = Intrinsics((24, 18), (25.0, 26.0), (11.5, 9.25), "opencv", (-0.1, 0, 0, 0, 0, 0, 0, 0))
    cameras = [Intrinsics((20, 18), (21.0, 21.0), (10.0, 9.0)), bent]
    world = mi.load_dict(WORLD)
    found = pose_bounds(world, PATH[:2], spp=16, cameras=cameras)
    white = found[0].provenance["noise"]["white"]
    for pose, own, bound in zip(PATH, cameras, found, strict=False):
        assert same(bound, pose_bound(world, pose=pose, camera=own, spp=16, exposure=white))
    with pytest.raises(CameraError, match=r"pose 'b': .* 40x36 is another shape"):
        pose_table(world, PATH[:2], names=["a", "b"], cameras=cameras, size=(40, 36))
    with pytest.raises(OptionError, match="3 poses have 2 cameras"):
        pose_bounds(world, PATH, cameras=cameras)
    with pytest.raises(OptionError, match="leave out camera"):
        pose_bounds(world, PATH[:2], cameras=cameras, camera=bent)


def test_bounds_do_not_depend_on_the_order_of_the_poses() -> None:
    poses = [PATH[0], AWAY, PATH[1], PATH[2]]
    found = pose_bounds(WORLD, poses, **FEW)
    for bound, again in zip(found, reversed(pose_bounds(WORLD, poses[::-1], **FEW)), strict=True):
        assert same(bound, again)


@pytest.mark.slow
def test_nuisances_and_a_prior_are_those_of_a_single_bound() -> None:
    plain = scene(wall=wall(texture()), ball={"type": "sphere", "center": [0.4, 0.3, 2.5], "radius": 0.3})
    plain["ball"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}
    given: dict[str, Any] = {"nuisances": ["gain", "ball.bsdf.reflectance.value"], "prior": 1e3 * np.eye(6)}
    alone = [pose_bound(plain, Gaussian(0.02), pose=pose, **given, **FEW) for pose in PATH]
    for bound, expected in zip(pose_bounds(plain, PATH, Gaussian(0.02), **given, **FEW), alone, strict=True):
        assert same(bound, expected)


@pytest.mark.slow
def test_all_poses_have_one_exposure_unless_each_is_to_have_its_own() -> None:
    def whites(poses: Sequence[Any], **more: Any) -> set[float]:
        return {bound.provenance["noise"]["white"] for bound in pose_bounds(WORLD, poses, **FEW, **more)}

    (pooled,) = whites(PATH)
    own = [pose_bound(WORLD, pose=pose, **FEW).provenance["noise"]["white"] for pose in PATH]
    assert min(own) < pooled < max(own)
    assert whites(PATH[:1]) == {own[0]}
    assert whites(PATH, exposure="auto") == set(own)
    assert whites(PATH, exposure=0.5) == {0.5}


@pytest.mark.parametrize("exposure", [None, "auto"])
def test_where_nothing_is_seen_the_rank_is_zero_and_it_is_no_error(exposure: Any) -> None:
    with pytest.raises(NoiseError, match="black"):
        pose_bound(WORLD, pose=INSIDE, **FEW)
    poses = [PATH[0], INSIDE, AWAY]
    table = pose_table(WORLD, poses, exposure=exposure, **FEW)
    assert [row.rank for row in table.rows] == [6, 0, 0]
    assert [row.name for row in table.lost] == ["1", "2"]
    for row in table.lost:
        assert np.isinf(row.position_std).all()
        assert "seen" not in row.verdicts
        assert np.isinf(row.ellipsoid).all()


def test_a_view_that_is_saturated_everywhere_is_a_row_of_rank_zero_and_says_so(tmp_path: Path) -> None:
    """As one into a lamp, by the exposure of all poses."""
    with pytest.raises(SaturatedError, match="saturated"):
        pose_bound(WORLD, pose=PATH[0], exposure=1e-6, **FEW)
    record = PoseFiles(tmp_path / "rows.json", None)
    table = pose_table(WORLD, PATH[:2], exposure=1e-6, record=record, **FEW)
    assert [row.rank for row in table.rows] == [0, 0]
    assert all(any("saturated" in note for note in row.notes) for row in table.rows)
    assert np.isinf(table.rows[0].position_std).all()
    np.testing.assert_allclose(table.rows[0].pose, PATH[0])
    (known,) = pose_bounds(WORLD, PATH[:1], prior=1e3 * np.eye(6), exposure=1e-6, **FEW)
    assert np.isfinite(known.position_std).all()


def test_where_all_is_black_it_says_why() -> None:
    with pytest.warns(SceneWarning, match="every image is black; of the first, no light reaches"):
        table = pose_table(WORLD, [INSIDE], **FEW)
    assert table.rows[0].rank == 0
    assert pose_table(WORLD, [INSIDE], exposure="auto", **FEW).rows[0].rank == 0


def test_what_is_no_pose_is_named_by_its_place() -> None:
    scaled = [PATH[0], np.diag([2.0, 2.0, 2.0, 1.0]), PATH[1]]
    with pytest.raises(PoseError, match=r"pose '1' \(2 of 3\) contains a scale"):
        pose_bounds(WORLD, scaled, **FEW)
    with pytest.raises(PoseError, match=r"pose '17.250' \(2 of 3\)"):
        pose_table(WORLD, scaled, names=["17.000", "17.250", "17.500"], **FEW)
    with pytest.raises(PoseError, match="no poses"):
        pose_bounds(WORLD, np.empty((0, 4, 4)), **FEW)
    with pytest.raises(PoseError, match="3 poses have 2 names"):
        pose_table(WORLD, PATH, names=["a", "b"], **FEW)
    with pytest.raises(PoseError, match="on a line"):
        pose_table(WORLD, PATH, names=["a", "b\n", "c"], **FEW)


def test_a_pose_beside_the_poses_is_refused() -> None:
    with pytest.raises(OptionError, match="leave out pose"):
        pose_bounds(WORLD, PATH, pose=PATH[0], **FEW)


def test_an_error_at_a_pose_names_it() -> None:
    far = PATH[1].copy()
    far[0, 3] = 1e9
    with pytest.raises(PrecisionError, match="pose 'far': "):
        pose_table(WORLD, [PATH[0], far], names=["near", "far"], **FEW)


class Memory:
    """A record that lives as long as the test."""

    def __init__(self, interrupt: int) -> None:
        self.rows: dict[int, PoseRow] = {}
        self.settings: dict[str, Any] | None = None
        self._interrupt = interrupt

    def earlier(self) -> dict[str, Any] | None:
        return self.settings

    def resume(self, settings: dict[str, Any], _poses: Any) -> dict[int, PoseRow]:
        assert self.settings in (None, settings)
        self.settings = settings
        return dict(self.rows)

    def add(self, index: int, row: PoseRow, _bound: PoseBound) -> None:
        if len(self.rows) == self._interrupt:
            self._interrupt = -1
            raise KeyboardInterrupt
        self.rows[index] = row


def rows_of(table: PoseTable) -> list[dict[str, Any]]:
    return [row.columns() | {"seconds": 0} for row in table.rows]


@pytest.mark.slow
def test_an_interrupted_run_goes_on_where_it_stopped() -> None:
    whole = pose_table(WORLD, PATH, **FEW)
    assert not whole.interrupted
    record, done = Memory(interrupt=2), []
    first = pose_table(WORLD, PATH, record=record, **FEW)
    assert first.interrupted
    assert rows_of(first) == rows_of(whole)[:2]
    again = pose_table(WORLD, PATH, record=record, on_pose=lambda *counts: done.append(counts), **FEW)
    assert done == [(2, 3), (3, 3)]
    assert rows_of(again) == rows_of(whole)
    assert again.settings == whole.settings
    with pytest.raises(KeyboardInterrupt):
        pose_table(WORLD, PATH, record=Memory(interrupt=0), **FEW)


def test_an_answer_of_an_interrupted_round_is_no_row(monkeypatch: pytest.MonkeyPatch) -> None:
    from mitsuba_crb.measure import many as module

    calls = []

    def interrupted(*args: Any, **kwargs: Any) -> PoseBound:
        found = pose_bound(*args, **kwargs)
        calls.append(found)
        if len(calls) == 2:
            found.provenance["sampling"] = {"interrupted": True}
        return found

    monkeypatch.setattr(module, "pose_bound", interrupted)
    assert len(pose_table(WORLD, PATH, **FEW).rows) == 1


@pytest.mark.slow
def test_settings_tell_runs_apart_whose_rows_would_differ() -> None:
    def settings(poses: Any = PATH[:1], world: Any = WORLD, **more: Any) -> str:
        found = pose_table(world, poses, **FEW | more).settings
        return json.dumps({name: value for name, value in found.items() if name != "white"})

    mask = np.zeros((18, 24), dtype=bool)
    mask[4:9] = True
    variants = [
        settings(),
        settings(PATH[1:2]),
        settings(names=["a"]),
        settings(world=scene(wall=wall(texture(1)), box=BOX, sensor=camera())),
        settings(seed=1),
        settings(spp=32),
        settings(pixels=mask),
        settings(pixels=~mask),
        settings(noise=Gaussian(0.1)),
        settings(exposure=0.9),
        settings(clip=False),
        settings(frame="world"),
        settings(nuisances=["gain"]),
        settings(prior=np.eye(6)),
        settings(prior=2.0 * np.eye(6)),
    ]
    assert len(set(variants)) == len(variants)
    assert settings(tile=8) == settings() == settings(on_pose=lambda *_: None)


def test_a_loaded_scene_is_taken_as_it_is() -> None:
    loaded = mi.load_dict(WORLD)
    found = pose_bounds(loaded, PATH[:1], Gaussian(0.02), spp=16)
    assert same(found[0], pose_bound(loaded, Gaussian(0.02), pose=PATH[0], spp=16))


def test_the_table_says_what_it_holds() -> None:
    table = PoseTable.of(pose_bounds(WORLD, [*PATH, AWAY], **FEW))
    assert "rank 6 at 3, 0 at 1" in str(table)
    columns = table.columns()
    assert columns["name"] == ["0", "1", "2", "3"]
    assert {len(values) for values in columns.values()} == {4}
    assert PoseTable((), (), 3, {}).columns() == {}
    assert "0 of 3" in str(PoseTable((), (), 3, {}))

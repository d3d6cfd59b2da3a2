"""Bounds at many views, in a store: each is that of its pose alone, whoever measured it and however often."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import xarray
import zarr
from small_scenes import T, camera, scene, texture, wall
from small_splats import write_splats

from mitsuba_crb import pose_bound, pose_bounds, se3
from mitsuba_crb.bound.cramer_rao import PoseBound
from mitsuba_crb.camera import Intrinsics
from mitsuba_crb.errors import OptionError, OutputError, PoseError, SaturatedError, StoreError, WorkerError
from mitsuba_crb.measure.opening import open_measurable
from mitsuba_crb.measure.options import MeasurementOptions
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.planning import field_run, view_work
from mitsuba_crb.planning.candidates import Candidates, candidates_of
from mitsuba_crb.planning.field_run import measure_field
from mitsuba_crb.planning.layout import BLOCKED, INSIDE, MEASURED, TO_DO
from mitsuba_crb.planning.view_field import ViewField, open_field
from mitsuba_crb.radiance.hashgrid import HashGrid
from mitsuba_crb.radiance.network import Design, new_weights
from mitsuba_crb.radiance.occupancy import everywhere
from mitsuba_crb.radiance.scene_space import SceneSpace

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

FEW: dict[str, Any] = {"size": (12, 8), "spp": 16}
BOX = {"type": "cube", "to_world": T().translate([3.0, 0, 1.0]).scale(0.4)}
WORLD = scene(wall=wall(texture()), box=BOX, sensor=camera())
PATH = candidates_of(
    [se3.exp([0.2 * k, 0.1 * k, 0.3 * k, 0.02 * k, -0.03 * k, 0.1 * k]) for k in range(3)], up=[0, 1, 0]
)


@pytest.fixture
def splats(tmp_path: Path) -> Path:
    """A file whose views are measured in no time."""
    return write_splats(tmp_path)


def around(file: Path, count: int = 5) -> Candidates:
    with open_measurable(file, MeasurementOptions()) as view:
        first = view.pose
    return candidates_of([first @ se3.exp([0.02 * k, 0, 0.03 * k, 0, 0.01 * k, 0]) for k in range(count)])


def values(field: ViewField) -> dict[str, bytes]:
    """All bits, but for how long it took."""
    data = field.dataset.data_vars.items()
    return {name: array.values.tobytes() for name, array in data if name != "seconds"}


def is_that_of(field: ViewField, index: int, bound: PoseBound) -> bool:
    row = {name: array.values[index] for name, array in field.dataset.data_vars.items()}
    expected = view_work.view_values(bound)
    return all(
        np.array_equal(row[name], np.asarray(value, row[name].dtype), equal_nan=True)
        for name, value in expected.items()
    )


@pytest.mark.slow
@pytest.mark.parametrize("options", [FEW, {"size": (12, 8), "precision": 0.2}], ids=["spp", "precision"])
def test_each_view_is_that_of_its_pose_alone(options: dict[str, Any], tmp_path: Path) -> None:
    world = WORLD
    field = measure_field(world, PATH, tmp_path / "views.zarr", **options)
    assert field.status.tolist() == [MEASURED] * 3
    assert field.usable.all()
    white = field.settings["white"]
    many = pose_bounds(world, PATH.poses, **options)
    for index, (pose, bound) in enumerate(zip(PATH.poses, many, strict=True)):
        assert is_that_of(field, index, bound)
        assert is_that_of(field, index, pose_bound(world, pose=pose, exposure=white, **options))
    assert not is_that_of(field, 0, many[1])
    assert (field.dataset["seconds"].values > 0.0).all()
    assert field.dataset["paths"].values.min() >= 12 * 8 * 8


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["splats", "hash grid"])
def test_a_radiance_field_s_views_are_those_of_its_bounds(kind: str, splats: Path, tmp_path: Path) -> None:
    if kind == "splats":
        world: Any = splats
        views, options = around(splats, 2), {}
    else:
        world = small_hash_grid()
        views = candidates_of([se3.exp([0.3, -0.2, -2.1, 0.1, 0.2, z]) for z in (-0.3, 0.3)])
        options = {"camera": Intrinsics((12, 8), (15.0, 15.0), (6.0, 4.0))}
    field = measure_field(world, views, tmp_path / "views.zarr", **options)
    for index, pose in enumerate(views.poses):
        bound = pose_bound(world, pose=pose, **options)
        assert bound.rank == 6
        assert is_that_of(field, index, bound)
    assert field.settings["deterministic"]
    assert not field.dataset["paths"].values.any()


def small_hash_grid() -> HashGrid:
    design = Design(levels=4, features=2, coarsest=4, finest=24, table=2**10, hidden=16, cells=16, steps=40)
    weights = new_weights(design, 3)
    weights["w2"][0] *= 3.0
    entries = np.random.default_rng(3).normal(size=design.encoding(0).n_params).astype(np.float32)
    space = SceneSpace((0.2, -0.1, 0.4), 2.5)
    return HashGrid("made", design, space, entries, weights, everywhere(design.cells), (0.1, 0.5, 0.9))


@pytest.mark.slow
def test_of_colour_and_depth_and_with_a_prior_the_information_is_the_image_s_alone(tmp_path: Path) -> None:
    world = WORLD
    for k, options in enumerate(({"measure": "rgbd"}, {"nuisances": ["gain"]})):
        both = {
            prior: measure_field(
                world,
                PATH,
                tmp_path / f"{k}{prior}.zarr",
                noise=Gaussian(0.1),
                prior=prior * np.eye(6),
                **options,
                **FEW,
            )
            for prior in (1.0, 1e6)
        }
        weak, strong = both[1.0], both[1e6]
        assert np.all(strong.position_bound < weak.position_bound)
        if "nuisances" in options:
            same = [field.dataset["information_camera"].values for field in both.values()]
            assert np.array_equal(*same)


def test_informations_are_those_of_one_body(tmp_path: Path) -> None:
    field = measure_field(WORLD, PATH, tmp_path / "views.zarr", **FEW)
    total = sum(field.information()[1:], start=field.information()[0])
    assert (total.variable, total.frame) == ("body", "world")
    stored = field.dataset["information"].values.sum(axis=0)
    assert np.allclose(total.matrix, stored, rtol=1e-9, atol=1e-9 * np.abs(stored).max())


def test_anybody_s_xarray_reads_it(splats: Path, tmp_path: Path) -> None:
    store = tmp_path / "views.zarr"
    field = measure_field(splats, around(splats), store)
    dataset = xarray.open_zarr(store, consolidated=False)
    assert dataset["position_bound"].dims == ("view",)
    assert dataset["position_bound"].attrs["units"] == "scene_unit"
    assert dataset["rank"].dtype == np.int8
    assert dataset["position_verdict"].attrs["flag_meanings"] == "seen unseen not_resolved"
    assert zarr.open_group(store, mode="r").metadata.zarr_format == 3
    assert field.settings["versions"]["mitsuba_crb"]
    assert field.candidates["kind"] == "poses"
    assert len(open_field(store)) == 5


@pytest.mark.slow
def test_batches_and_order_change_no_bit(splats: Path, tmp_path: Path) -> None:
    views = around(splats)
    one = measure_field(splats, views, tmp_path / "1.zarr", batch=1)
    three = measure_field(splats, views, tmp_path / "3.zarr", batch=3)
    assert values(one) == values(three)
    turned = candidates_of(views.poses[::-1])
    back = measure_field(splats, turned, tmp_path / "back.zarr")
    for name in ("information", "position_std", "weakest"):
        assert np.array_equal(back.dataset[name].values[::-1], one.dataset[name].values)


@pytest.mark.slow
def test_views_from_nowhere_are_not_measured(
    splats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = around(splats)
    codes = np.array([INSIDE, TO_DO, BLOCKED, TO_DO, BLOCKED], dtype=np.int8)
    monkeypatch.setattr(field_run, "view_status", lambda *_: codes)
    field = measure_field(splats, views, tmp_path / "views.zarr", batch=2)
    assert field.status.tolist() == [INSIDE, MEASURED, BLOCKED, MEASURED, BLOCKED]
    assert field.usable.tolist() == [False, True, False, True, False]
    assert not field.interrupted
    lost = ~field.usable
    assert field.rank[lost].tolist() == [0, 0, 0]
    assert np.isinf(field.position_bound[lost]).all()
    assert np.isinf(field.dataset["rotation_std_deg"].values[lost]).all()
    assert not field.dataset["information"].values[lost].any()
    assert not any(
        one.matrix.any() for one, is_lost in zip(field.information(), lost, strict=True) if is_lost
    )
    monkeypatch.undo()
    free = measure_field(splats, views, tmp_path / "free.zarr")
    assert np.array_equal(free.position_bound[~lost], field.position_bound[~lost])


def test_where_all_is_saturated_an_image_tells_nothing_and_the_run_goes_on(tmp_path: Path) -> None:
    with pytest.raises(SaturatedError, match="saturated"):
        pose_bound(WORLD, pose=PATH.poses[0], exposure=1e-5, **FEW)
    field = measure_field(WORLD, PATH, tmp_path / "views.zarr", exposure=1e-5, **FEW)
    assert field.done.all()
    assert field.rank.tolist() == [0, 0, 0]
    assert np.isinf(field.position_bound).all()
    assert not any(one.matrix.any() for one in field.information())


@pytest.mark.slow
@pytest.mark.parametrize("when", [1, 3])
def test_an_interrupted_run_goes_on_where_it_stopped(splats: Path, tmp_path: Path, when: int) -> None:
    views, store = around(splats), tmp_path / "views.zarr"
    whole = measure_field(splats, views, tmp_path / "whole.zarr", batch=1)
    told: list[tuple[int, int]] = []

    def interrupt(done: int, total: int) -> None:
        told.append((done, total))
        if done == when:
            raise KeyboardInterrupt

    first = measure_field(splats, views, store, batch=1, on_view=interrupt)
    assert first.interrupted
    assert int(first.done.sum()) == when
    assert np.isnan(first.position_bound[when:]).all()
    assert told == [(k, 5) for k in range(when + 1)]
    told.clear()
    again = measure_field(splats, views, store, on_view=lambda *counts: told.append(counts))
    assert told == [(k, 5) for k in range(when, 6)]
    assert values(again) == values(whole)
    assert again.dataset.attrs == whole.dataset.attrs


@pytest.mark.slow
@pytest.mark.parametrize("written", [0, 3, 40, 70, 110])
def test_a_full_disk_costs_what_was_in_flight(
    splats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    from zarr.storage import _local

    views, store = around(splats), tmp_path / "views.zarr"
    whole = measure_field(splats, views, tmp_path / "whole.zarr", batch=2)
    put, count = _local._put, 0

    def full(*args: Any, **kwargs: Any) -> Any:
        nonlocal count
        count += 1
        if count > written:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return put(*args, **kwargs)

    monkeypatch.setattr(_local, "_put", full)
    with pytest.raises(OutputError, match=r"cannot write .*views.zarr: No space left on device"):
        measure_field(splats, views, store, batch=2)
    monkeypatch.undo()
    assert not [file for file in tmp_path.iterdir() if file.name.endswith(".tmp")]
    if store.exists():
        done = open_field(store).done
        assert not done.all()
        assert values(whole)["done"] != done.tobytes()
    assert values(measure_field(splats, views, store, batch=2)) == values(whole)


@pytest.mark.slow
def test_workers_change_no_bit_and_one_that_is_killed_costs_what_it_had(scenes: Path, tmp_path: Path) -> None:
    file = scenes / "textured_wall" / "textured_wall.xml"
    views = around(file, 40)
    options: dict[str, Any] = {"size": (12, 8), "spp": 16, "batch": 1}
    whole = measure_field(file, views, tmp_path / "whole.zarr", **options)
    store = tmp_path / "views.zarr"

    def kill(done: int, _: int) -> None:
        if done == 2:
            os.kill(multiprocessing.active_children()[0].pid or 0, signal.SIGKILL)

    with pytest.raises(
        WorkerError, match=r"ended before it had answered.*of 40 views are done, and the same"
    ):
        measure_field(file, views, store, workers=2, on_view=kill, **options)
    assert 2 <= int(open_field(store).done.sum()) < 40
    again = measure_field(file, views, store, workers=2, **options)
    assert values(again) == values(whole)
    assert again.dataset.attrs == whole.dataset.attrs


def test_no_kernel_is_compiled_after_the_first_view(tmp_path: Path) -> None:
    world, compiled = WORLD, []

    def count(*_: int) -> None:
        compiled.append(sum(not kernel.get("cache_hit", True) for kernel in dr.kernel_history()))
        dr.kernel_history_clear()

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        measure_field(world, PATH, tmp_path / "views.zarr", batch=1, on_view=count, **FEW)
    assert len(compiled) == 4
    assert compiled[2:] == [0, 0]


# Effort


@pytest.mark.slow
def test_a_limit_saves_paths_where_it_is_far_and_changes_nothing_where_it_is_near(tmp_path: Path) -> None:
    world, small = WORLD, {"size": (12, 8), "noise": Gaussian(0.1)}
    views = candidates_of(PATH.poses[:2], up=[0, 1, 0])
    plain = measure_field(world, views, tmp_path / "plain.zarr", precision=0.02, **small)
    far, near = (
        measure_field(world, views, tmp_path / f"{limit}.zarr", limit=limit, precision=0.02, **small)
        for limit in (0.1 * plain.position_bound.min(), plain.position_bound[1])
    )
    paths = [field.dataset["paths"].values for field in (plain, far, near)]
    assert np.all(paths[1] < 0.5 * paths[0])
    assert paths[2][1] > paths[0][1]
    for index, pose in enumerate(views.poses):
        assert np.array_equal(
            far.dataset["position_std"].values[index],
            pose_bound(world, pose=pose, precision=0.08, **small).position_std,
        )
    assert np.array_equal(near.dataset["information"].values[1], plain.dataset["information"].values[1])
    with pytest.raises(OptionError, match="leave out one of them"):
        measure_field(world, PATH, tmp_path / "no.zarr", limit=1.0, **FEW)
    with pytest.raises(OptionError, match="positive and finite"):
        measure_field(world, PATH, tmp_path / "no.zarr", limit=-1.0, size=(12, 8))


# Bad input


def test_a_store_of_something_else_is_refused_with_what_differs(splats: Path, tmp_path: Path) -> None:
    views, store = around(splats), tmp_path / "views.zarr"
    before = values(measure_field(splats, views, store))
    other = write_splats(_folder(tmp_path / "other"), seed=1)
    for world, candidates, options, words in (
        (splats, views, {"seed": 1}, "seed = 0, not 1; name another store"),
        (splats, views, {"noise": Gaussian(0.5)}, "noise"),
        (splats, around(splats, 4), {}, "views.count = 5, not 4"),
        (other, views, {}, "scene_contents"),
        (splats, views, {"limit": 2.0}, "limit = None, not 2.0"),
    ):
        with pytest.raises(StoreError, match=words):
            measure_field(world, candidates, store, **options)
    with pytest.raises(StoreError, match=r"exists.*resume"):
        measure_field(splats, views, store, resume=False)
    assert values(open_field(store)) == before


def test_what_exists_and_is_no_store_is_left_alone(splats: Path, tmp_path: Path) -> None:
    views = around(splats)
    file, folder, group = tmp_path / "notes.txt", _folder(tmp_path / "folder"), tmp_path / "group.zarr"
    file.write_text("mine")
    (folder / "mine.txt").write_text("mine")
    zarr.create_group(group, attributes={"schema": 99})
    for path in (file, folder, group):
        with pytest.raises(StoreError, match="is left alone"):
            measure_field(splats, views, path)
    assert file.read_text() == (folder / "mine.txt").read_text() == "mine"
    assert [each.name for each in folder.iterdir()] == ["mine.txt"]
    with pytest.raises(StoreError, match="no such store"):
        open_field(tmp_path / "missing.zarr")
    with pytest.raises(OutputError, match=r"the folder .*missing does not exist; create it first"):
        measure_field(splats, views, tmp_path / "missing" / "views.zarr")


def test_what_is_no_pose_is_named(splats: Path, tmp_path: Path) -> None:
    views = around(splats)
    poses = views.poses.copy()
    poses[3] *= 2.0
    scaled = Candidates(poses, views.place, views.heading, views.up, views.description)
    with pytest.raises(PoseError, match=r"pose '3' \(4 of 5\)"):
        measure_field(splats, scaled, tmp_path / "views.zarr")
    assert not (tmp_path / "views.zarr").exists()


def test_workers_that_cannot_be(splats: Path, tmp_path: Path) -> None:
    views, store = around(splats), tmp_path / "views.zarr"
    for options, words in (
        ({"workers": 0}, "at least one worker"),
        ({"workers": 2, "scheduler": "tcp://127.0.0.1:1"}, "leave out --workers or --scheduler"),
        ({"batch": 0}, "at least one view"),
    ):
        with pytest.raises(OptionError, match=words):
            measure_field(splats, views, store, **options)
    with pytest.raises(OptionError, match="give the path of its file"):
        measure_field(mi.load_dict(WORLD), PATH, store, workers=2, **FEW)
    assert not store.exists()


def _setup(file: Path, **changes: Any) -> view_work.Setup:
    from mitsuba_crb.measure.opening import as_world, fingerprint
    from mitsuba_crb.measure.versions import versions

    given: dict[str, Any] = {
        "key": "a run",
        "path": str(file),
        "defines": {},
        "contents": fingerprint(as_world(file)[0], str(file), {}),
        "versions": versions(),
        "noise": Gaussian(0.1),
        "prior": None,
        "nuisances": (),
        "options": {},
        "limit": None,
    }
    return view_work.Setup(**given | changes)


def test_a_worker_that_is_different_says_so(splats: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mitsuba_crb.errors import LLVMError

    views = view_work.Views((4,), around(splats).poses[:1])
    assert view_work.measure_views(_setup(splats), views)["rank"].tolist() == [6]
    view_work._opened.clear()
    own = _setup(splats).versions
    for changes, words in (
        (
            {"versions": {**own, "drjit": "9.9", "mitsuba": "8"}},
            rf"process {os.getpid()} has mitsuba .*, not 8, drjit",
        ),
        ({"contents": "0" * 16}, "another world in .*splats.ply"),
        ({"versions": {**own, "variant": "cuda_ad_rgb"}}, f"process {os.getpid()}"),
    ):
        with pytest.raises(Exception, match=words) as caught:
            view_work.measure_views(_setup(splats, **changes), views)
        assert isinstance(caught.value, WorkerError) or "cuda" in words or "variant" in changes["versions"]
    missing = _setup(splats, path=str(splats.with_name("gone.ply")))
    with pytest.raises(Exception, match=rf"process {os.getpid()}: .*gone.ply"):
        view_work.measure_views(missing, views)

    def none() -> dict[str, str]:
        raise LLVMError("no LLVM was found")

    setup = _setup(splats)
    monkeypatch.setattr(view_work, "versions", none)
    with pytest.raises(LLVMError, match=rf"worker process {os.getpid()}: no LLVM"):
        view_work.measure_views(setup, views)


def _folder(path: Path) -> Path:
    path.mkdir()
    return path

from __future__ import annotations

import dataclasses
import json
import math
import os
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import synthetic_view
from matrices import misfit

from mitsuba_crb.bound.cramer_rao import cramer_rao_bound
from mitsuba_crb.errors import OutputError
from mitsuba_crb.export.documents import atomic, bound_document, write_json
from mitsuba_crb.export.exr import COLUMN_NAMES, write_exr
from mitsuba_crb.export.targets import check_target
from mitsuba_crb.files import jsonable
from mitsuba_crb.information.image_information import fisher_information
from mitsuba_crb.information.pixel_information import information_share
from mitsuba_crb.measure.pictures import Gathering, pictures_of
from mitsuba_crb.noise import Gaussian, PoissonGaussian

KEYS = {
    "schema",
    "scene",
    "method",
    "spp",
    "seed",
    "batches",
    "size",
    "pixels",
    "noise",
    "frame",
    "twist_order",
    "units",
    "length_scale",
    "information",
    "information_standard_error",
    "covariance",
    "position_std",
    "position_std_standard_error",
    "rotation_std_deg",
    "rotation_std_deg_standard_error",
    "eigenvalues",
    "eigenvalues_standard_error",
    "rank",
    "unobserved",
    "versions",
    "seconds",
}


def refuse_constant(text: str) -> None:
    raise AssertionError(f"not strict JSON: {text}")


@pytest.fixture(scope="module")
def view():
    return synthetic_view.jacobian()


@pytest.fixture(scope="module")
def blind():
    """Translation along the camera's y and rotation about its z leave no trace in the image."""
    return synthetic_view.bound(synthetic_view.jacobian(unseen=(1, 5), noise=0.05))


def test_what_json_cannot_hold_is_written_alike_wherever_it_lies():
    given = {
        "array": np.array([[1.5, np.inf], [-np.inf, np.nan]]),
        "numbers": (np.float32(0.5), np.int64(3), np.bool_(True), np.array(np.inf), math.nan),
        7: {"path": Path("a") / "b", "none": None},
    }
    plain = jsonable(given)
    assert plain == {
        "array": [[1.5, "inf"], ["-inf", None]],
        "numbers": [0.5, 3, True, "inf", None],
        "7": {"path": str(Path("a") / "b"), "none": None},
    }
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain


def test_document_has_every_key_and_round_trips(view, tmp_path):
    document = bound_document(synthetic_view.bound(view))
    assert set(document) >= KEYS
    assert document["schema"] == "mitsuba-crb/bound/1"
    path = tmp_path / "bound.json"
    write_json(path, document)
    assert json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse_constant) == document


def test_document_writes_the_unseen_as_inf_and_null(blind, tmp_path):
    assert blind.rank == 4
    path = tmp_path / "bound.json"
    write_json(path, bound_document(blind))
    document = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse_constant)
    assert document["rotation_std_deg"][2] == "inf"
    assert "inf" in document["position_std"]
    assert np.array(document["covariance"], dtype=object)[1, 1] == "inf"
    assert document["covariance"][1][0] is None
    assert len(document["unobserved"]) == 2
    assert all(len(entry["direction"]) == 6 and entry["description"] for entry in document["unobserved"])


def test_document_in_the_world_frame_turns_matrices_only(view):
    camera = synthetic_view.bound(view)
    world = cramer_rao_bound(camera.information.to_frame("world"))
    a, b = bound_document(camera), bound_document(world)
    for key in ("position_std", "rotation_std_deg", "position_std_standard_error"):
        np.testing.assert_allclose(a[key], b[key], rtol=1e-9)
    assert b["frame"] == "world"
    assert not np.allclose(a["information"], b["information"])


def test_exr_holds_image_and_named_columns(view, tmp_path):
    path = tmp_path / "view.exr"
    bound = synthetic_view.bound(view)
    write_exr(path, pictures_of(view, bound.information), {"scene": "relief.xml", "spp": 64})
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels, header = file.channels(), file.header()
        columns = {f"{n}.{c}" for n in COLUMN_NAMES for c in "RGB"}
        assert set(channels) == {"R", "G", "B", "weakest_share.Y"} | columns
        for c, name in enumerate("RGB"):
            assert channels[name].pixels.dtype == np.float32
            np.testing.assert_array_equal(channels[name].pixels, view.image[..., c].astype(np.float32))
        x, y = view.pixels.T
        for axis, name in enumerate(COLUMN_NAMES):
            got = channels[f"{name}.G"].pixels[y, x]
            np.testing.assert_allclose(got, view.values[:, 1, axis], rtol=1e-6, atol=1e-6)
        assert header["frame"] == "camera"
        assert header["twist_order"].split() == ["rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z"]
        np.testing.assert_array_equal(header["world_from_camera"], view.pose)
        assert header["length_scale"] == pytest.approx(view.length_scale)
        assert header["scene"] == "relief.xml"
        assert channels["weakest_share.Y"].pixels.sum() == pytest.approx(1.0, rel=1e-4)
        assert header["weakest"] == bound.weakest.description
        written = [float(word) for word in header["weakest_direction"].split()]
        np.testing.assert_allclose(written, bound.weakest.direction, rtol=1e-6, atol=1e-9)


def test_an_image_that_shows_nothing_has_no_weakest_direction_in_the_exr(tmp_path):
    view = synthetic_view.jacobian(unseen=(0, 1, 2, 3, 4, 5))
    pictures = pictures_of(view, synthetic_view.bound(view).information)
    assert pictures.weakest is None
    assert np.all(np.isnan(pictures.weakest_share))
    write_exr(tmp_path / "view.exr", pictures)
    with OpenEXR.File(str(tmp_path / "view.exr"), separate_channels=True) as file:
        assert "weakest_share.Y" not in file.channels()
        assert "weakest" not in file.header()


def test_unmeasured_pixels_are_nan(tmp_path):
    view = synthetic_view.jacobian(fraction=0.3, kind="random")
    path = tmp_path / "view.exr"
    write_exr(path, pictures_of(view, synthetic_view.bound(view).information))
    measured = np.zeros(view.image.shape[:2], bool)
    measured[view.pixels[:, 1], view.pixels[:, 0]] = True
    with OpenEXR.File(str(path), separate_channels=True) as file:
        for channel in file.channels().values():
            np.testing.assert_array_equal(np.isfinite(channel.pixels), measured)


def test_columns_in_the_world_frame_are_those_of_the_information(view):
    """Σ J_worldᵀ J_world / σ² of the pictures is the plain information in the world frame."""
    bound = synthetic_view.bound(view)
    world = bound.information.to_frame("world")
    gathering = Gathering()
    gathering.add(view.pixels, view.mean, view.batch_values)
    height, width = view.image.shape[:2]
    pictures = gathering.pictures(world, (width, height), frame="world")
    whole = pictures.columns.astype(np.float64).reshape(-1, 6)
    plain = whole.T @ whole / synthetic_view.SIGMA**2
    # float32 columns, of which the sum's relative error is far below 1e-5
    assert misfit(plain, world.plain_matrix) < 1e-5


@pytest.mark.parametrize(("kind", "fraction"), [("all", 1.0), ("only", 0.4), ("random", 0.4)])
def test_information_density_sums_to_the_scaled_trace(kind, fraction):
    view = synthetic_view.jacobian(kind=kind, fraction=fraction)
    information = synthetic_view.bound(view).information
    trace = np.diag(information.matrix) @ np.array([view.length_scale**2] * 3 + [1.0] * 3)
    weighted = pictures_of(view, information, Gaussian(synthetic_view.SIGMA)).information
    assert np.nansum(weighted) == pytest.approx(trace, rel=1e-9)

    gathering = Gathering()
    for half in np.array_split(np.arange(len(view.pixels)), 2):
        weights = np.full(view.mean[half].shape, synthetic_view.SIGMA**-2)
        gathering.add(view.pixels[half], view.mean[half], view.batch_values[:, half], weights)
    later = gathering.pictures(information, view.image.shape[1::-1])
    np.testing.assert_allclose(later.information, weighted, rtol=1e-12)


def test_information_density_sums_to_the_trace_where_noise_depends_on_the_image_too(view):
    """The noise reads the pilot, which is twice as bright as the image here."""
    photons = PoissonGaussian(0.01, 0.02)
    view = dataclasses.replace(view, pilot=2.0 * view.image)
    information = fisher_information(view, photons)
    trace = np.diagonal(information.matrix) @ information.scale**2
    pictures = pictures_of(view, information, photons)
    assert np.nansum(pictures.information) == pytest.approx(trace, rel=1e-9)
    dim = fisher_information(dataclasses.replace(view, pilot=None), photons)
    assert np.diagonal(dim.matrix) @ dim.scale**2 > 1.2 * trace
    share = information_share(view, photons, pictures.weakest.direction)
    np.testing.assert_allclose(share, pictures.weakest_share, rtol=1e-9)


def test_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "out.json"
    path.write_text("old")

    def interrupted():
        with atomic(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["out.json"]


def test_failed_exr_leaves_the_old_file_and_nothing_else(view, tmp_path, monkeypatch):
    path = tmp_path / "out.exr"
    path.write_text("old")

    class FullDisk:
        def __init__(self, *_):
            pass

        def write(self, name):
            Path(name).write_text("half")
            raise RuntimeError("No space left on device")

    monkeypatch.setattr(OpenEXR, "File", FullDisk)
    with pytest.raises(OutputError, match="No space left"):
        write_exr(path, pictures_of(view, synthetic_view.bound(view).information))
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["out.exr"]


def test_new_files_have_the_usual_permissions_and_links_stay_links(tmp_path):
    real, link = tmp_path / "real.json", tmp_path / "link.json"
    real.write_text("old")
    link.symlink_to(real)
    write_json(link, {"a": 1})
    assert link.is_symlink()
    assert json.loads(real.read_text()) == {"a": 1}
    reference = tmp_path / "reference"
    reference.touch()
    assert real.stat().st_mode == reference.stat().st_mode


def test_target_check_names_what_is_wrong_and_leaves_no_trace(tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text("<scene/>")
    check_target(tmp_path / "new.json", "--json")
    check_target(Path("new.json"), "--json")
    cases = [
        (tmp_path / "no" / "a.json", "does not exist"),
        (tmp_path, "is a folder"),
        (scene, "overwrite an input"),
        (Path("/dev/null"), "not a regular file"),
    ]
    for path, words in cases:
        with pytest.raises(OutputError, match=words):
            check_target(path, "--json", [scene])
    assert os.listdir(tmp_path) == ["scene.xml"]


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder in which nobody can write")
def test_target_check_refuses_a_folder_that_cannot_be_written_even_by_root():
    with pytest.raises(OutputError, match="cannot write in the folder /proc/self"):
        check_target(Path("/proc/self/bound.json"), "--json")


def test_a_record_of_trials_is_overwritten_by_nothing_else(tmp_path):
    record = tmp_path / "trials.json"
    for text in (
        '{"schema": "mitsuba-crb/validate/1", "results": []}',
        '{\n  "schema": "mitsuba-crb/validate/1"}',
    ):
        record.write_text(text)
        for option in ("--json", "--exr", "--plot"):
            with pytest.raises(OutputError, match=f"{option} .*trials that would be lost; name another file"):
                check_target(record, option)
        check_target(record, "--json", resumes=True)
        assert record.read_text() == text
    record.write_text('{"schema": "mitsuba-crb/bound/1"}')
    check_target(record, "--json")

"""Files of splats mean the same in every format; what cannot be drawn is counted; damage is named."""

from __future__ import annotations

import gzip
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from splat_files import mesh_ply, ply, records, some_columns

from mitsuba_crb.datasets.splats import Splats, is_splats, load_splats
from mitsuba_crb.errors import FieldError, FieldWarning

ARRAYS = ("means", "rotations", "scales", "opacities", "coefficients")


def loaded(folder: Path, data: bytes) -> Splats:
    path = folder / "file"
    path.write_bytes(data)
    return load_splats(path)


def alike(one: Splats, other: Splats, tolerance: float) -> bool:
    return all(np.allclose(getattr(one, name), getattr(other, name), 0.0, tolerance) for name in ARRAYS)


@pytest.mark.parametrize("degree", range(5))
def test_inria_columns_mean_what_its_rasteriser_takes_them_for(degree: int, tmp_path: Path) -> None:
    columns = some_columns(degree=degree)
    splats = loaded(tmp_path, ply(columns, kind="double"))
    rest = (degree + 1) ** 2 - 1
    assert splats.degree == degree
    np.testing.assert_allclose(splats.scales[:, 1], np.exp(columns["scale_1"]))
    np.testing.assert_allclose(np.log(splats.opacities / (1 - splats.opacities)), columns["opacity"])
    np.testing.assert_allclose(splats.coefficients[:, 0, 2], columns["f_dc_2"], rtol=1e-6)
    for channel in range(3):  # all of red's, then all of green's, then all of blue's
        for k in range(rest):
            stored = columns[f"f_rest_{channel * rest + k}"]
            np.testing.assert_allclose(splats.coefficients[:, 1 + k, channel], stored, rtol=1e-6)


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("kind", ["float", "double"])
def test_a_ply_is_the_same_in_any_order_of_columns_and_bytes(form: str, kind: str, tmp_path: Path) -> None:
    columns = some_columns()
    names = [name for name in np.random.default_rng(1).permutation(list(columns)) if name != "ny"]
    shuffled = {name: columns[name] for name in names} | {"extra": columns["x"]}
    expected = loaded(tmp_path, ply(columns))
    assert alike(loaded(tmp_path, ply(shuffled, form, kind)), expected, 1e-6)


def test_a_splat_file_is_the_same_scene_to_its_bytes(tmp_path: Path) -> None:
    columns = some_columns(200, degree=0)
    exact, rounded = loaded(tmp_path, ply(columns)), loaded(tmp_path, records(columns))
    np.testing.assert_allclose(rounded.means, exact.means, rtol=1e-6)
    np.testing.assert_allclose(rounded.scales, exact.scales, rtol=1e-6)
    np.testing.assert_allclose(rounded.opacities, exact.opacities, atol=1.0 / 255)
    turned = np.abs(np.sum(rounded.rotations * exact.rotations, axis=1))
    assert turned.min() > 1.0 - 2e-4


def test_the_blur_in_space_of_mip_splatting_is_applied(tmp_path: Path) -> None:
    columns = some_columns()
    plain = loaded(tmp_path, ply(columns))
    blurred = loaded(tmp_path, ply(columns | {"filter_3D": np.full(30, 0.05)}))
    np.testing.assert_allclose(blurred.scales**2, plain.scales**2 + 0.05**2, rtol=1e-5)
    mass = [splats.opacities * np.prod(splats.scales, axis=1) for splats in (plain, blurred)]
    np.testing.assert_allclose(mass[1], mass[0], rtol=1e-5)


def test_covariances_are_those_of_rotated_axes() -> None:
    half = np.sqrt(0.5)
    splats = Splats(
        np.zeros((1, 3)),
        np.array([[half, 0.0, 0.0, half]]),  # a quarter turn about z
        np.array([[3.0, 2.0, 1.0]]),
        np.ones(1),
        np.zeros((1, 1, 3), dtype=np.float32),
    )
    np.testing.assert_allclose(splats.covariances[0], np.diag([4.0, 9.0, 1.0]), atol=1e-12)


def test_what_cannot_be_drawn_is_counted_and_left_out(tmp_path: Path) -> None:
    columns = some_columns(30)
    columns["x"][0] = np.nan
    columns["f_rest_3"][1] = np.nan
    columns["y"][2] = np.inf
    columns["scale_0"][3] = 1e4  # its exponential is infinite
    for k in range(4):
        columns[f"rot_{k}"][4] = 0.0
    columns["z"][5] = 1e12
    columns["scale_2"][6] = 25.0
    told = "2 NaN; 2 infinite; 1 without a rotation.*; 2 more than 1e\\+06 times"
    with pytest.warns(FieldWarning, match=told) as warned:
        splats = loaded(tmp_path, ply(columns))
    assert len(splats) == 23
    assert len(warned) == 1


def test_extremes_that_mean_something_stay(tmp_path: Path) -> None:
    columns = some_columns(5)
    columns["opacity"][:2] = [np.inf, -np.inf]
    columns["scale_1"][2] = -np.inf
    for k in range(4):
        columns[f"rot_{k}"][3] *= 1e-3
    splats = loaded(tmp_path, ply(columns))
    assert splats.opacities[:2].tolist() == [1.0, 0.0]
    assert splats.scales[2, 1] == 0.0
    np.testing.assert_allclose(np.linalg.norm(splats.rotations, axis=1), 1.0)


def without(*names: str) -> dict[str, np.ndarray]:
    return {name: values for name, values in some_columns().items() if name not in names}


def zipped(path: Path) -> bytes:
    with zipfile.ZipFile(path / "zip", "w") as archive:
        for name in ("meta.json", "means_l.webp"):
            archive.writestr(name, "")
    return (path / "zip").read_bytes()


REFUSED = {
    "a mesh": (lambda _: mesh_ply(), "something else than splats", False),
    "cut off": (lambda _: ply(some_columns())[:-7], "cut off: its header promises 30 .* it holds 29", True),
    "text, cut off": (lambda _: ply(some_columns(), "ascii")[:-60], "cut off or damaged", True),
    "words": (
        lambda _: ply(some_columns(), "ascii").rstrip()[:-1] + b"x",
        "something else than numbers",
        True,
    ),
    "a column short": (lambda _: ply(without("f_rest_8")), "8 columns f_rest", True),
    "a gap": (lambda _: ply(without("f_rest_3") | {"f_rest_9": np.ones(30)}), "9 columns f_rest", True),
    "no opacity": (lambda _: ply(without("opacity")), "lacks opacity", True),
    "2D Gaussians": (lambda _: ply(without("scale_2")), "2D Gaussians", True),
    "none": (lambda _: ply(some_columns(0)), "no splat that can be drawn", True),
    "none left": (lambda _: ply(some_columns() | {"x": np.full(30, np.nan)}), r"no splat .*30 NaN", True),
    "a broken header": (lambda _: b"ply\nformat binary 1.0\nend_header\n", "makes no sense", False),
    "no file of splats": (lambda _: b"hello" * 9, "no file of splats", False),
    ".splat, cut off": (lambda _: records(some_columns())[:-5], "no multiple of 32", False),
    "zeros": (lambda _: bytes(320), "no file of splats", False),
    "nothing": (lambda _: b"", "no file of splats", False),
    "SPZ": (lambda _: gzip.compress(b"NGSP" + bytes(60)), r"is SPZ.* npx @playcanvas/splat-transform", True),
    "SOG of another version": (
        lambda _: b'{"means": 1, "scales": 1, "quats": 1, "sh0": 1}',
        "SOG of version None",
        True,
    ),
    "damaged SOG": (
        lambda _: b'{"version": 2, "means": 1, "scales": 1, "quats": 1, "sh0": 1}',
        "damaged SOG",
        True,
    ),
    "an empty SOG": (zipped, "meta.json that is no JSON", True),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_bad_files_are_refused_in_one_line_that_names_the_cure(kind: str, tmp_path: Path) -> None:
    data, message, announced = REFUSED[kind]
    with pytest.raises(FieldError, match=message) as error:
        loaded(tmp_path, data(tmp_path))
    assert "\n" not in str(error.value)
    assert is_splats(tmp_path / "file") == announced


def test_folders_and_absent_files_are_no_splats(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "absent"):
        assert not is_splats(path)
        with pytest.raises(FieldError):
            load_splats(path)


@pytest.mark.parametrize("write", [ply, records])
def test_any_damage_is_refused_in_one_line_or_read(write, tmp_path: Path) -> None:
    whole, rng = write(some_columns(degree=0)), np.random.default_rng(3)
    lines = []
    for _ in range(60):
        i, j = np.sort(rng.integers(len(whole), size=2))
        piece = bytes(rng.integers(256, size=rng.integers(1, 9), dtype=np.uint8))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FieldWarning)
            try:
                loaded(
                    tmp_path,
                    [whole[:i], whole[:i] + whole[j:], whole[:i] + piece + whole[i:]][rng.integers(3)],
                )
            except FieldError as error:
                lines.append(str(error))
    assert lines
    assert not [line for line in lines if "\n" in line or len(line) > 600]


@pytest.mark.parametrize(
    ("one", "other", "turned"),
    [
        ("guitar_90854/guitar.compressed.ply", "guitar_90854/guitar_inria.ply", 1e-6),
        ("playbot_lod/sog_original_lod4/meta.json", "playbot_lod/playbot_lod4_8406.ply", 1e-6),
        # The converter takes 127.5 for the byte of 0, the format's author 128.
        ("indoor_hall_9080/model_22764.splat", "indoor_hall_9080/model_22764_inria.ply", 1e-2),
    ],
)
def test_files_by_others_agree_with_what_their_converter_made_of_them(
    one: str, other: str, turned: float, gaussians: Path
) -> None:
    first, second = load_splats(gaussians / one), load_splats(gaussians / other)
    size = np.abs(second.covariances).max()
    np.testing.assert_allclose(first.means, second.means, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(first.scales, second.scales, rtol=2e-5)
    np.testing.assert_allclose(first.covariances, second.covariances, rtol=0.0, atol=turned * size)
    np.testing.assert_allclose(first.opacities, second.opacities, rtol=0.0, atol=1e-5)  # logits up to 12
    np.testing.assert_allclose(first.coefficients, second.coefficients, rtol=0.0, atol=1e-6)

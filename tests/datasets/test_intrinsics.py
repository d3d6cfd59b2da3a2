"""Cameras by other tools: the same one in every format, files by others, and what is refused in one line."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from camera_files import FISHEYE, OPENCV, PINHOLE, TEXTS, colmap_binary, distorted, kalibr, own, written

from mitsuba_crb import Intrinsics, load_camera
from mitsuba_crb.camera import LENS_MODELS
from mitsuba_crb.cli.arguments import camera_file, parse_camera
from mitsuba_crb.errors import CameraError

CAMERAS = {"pinhole": PINHOLE, "opencv": OPENCV, "fisheye": FISHEYE}


def numbers(camera: Intrinsics) -> np.ndarray:
    """All of a camera's numbers; coefficients that its model leaves out are zero."""
    coefficients = dict(zip(LENS_MODELS[camera.model], camera.distortion, strict=True))
    named = [coefficients.get(name, 0.0) for name in LENS_MODELS["opencv"]]
    return np.array([*camera.size, *camera.focal, *camera.centre, *named])


def refused(path: Path, name: str | None = None) -> str:
    """The line that refuses the file."""
    with pytest.raises(CameraError) as caught:
        load_camera(path, name)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("form", TEXTS)
def test_one_camera_is_the_same_in_every_format(form: str, camera: Intrinsics, tmp_path: Path) -> None:
    read = load_camera(written(tmp_path, TEXTS[form](camera)))
    # half a pixel taken off and added again costs the last digit
    np.testing.assert_allclose(numbers(read), numbers(camera), rtol=1e-14, atol=1e-16)
    assert camera.model in {read.model, "pinhole"}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_colmaps_binary_cameras_are_read_bit_for_bit(camera: Intrinsics, tmp_path: Path) -> None:
    assert load_camera(written(tmp_path, colmap_binary(camera))) == camera


@pytest.mark.parametrize("form", TEXTS)
def test_windows_line_ends_and_a_byte_order_mark_change_nothing(form: str, tmp_path: Path) -> None:
    text = TEXTS[form](OPENCV)
    plain = load_camera(written(tmp_path, text))
    windows = b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode()
    assert load_camera(written(tmp_path, windows)) == plain


@pytest.mark.parametrize(
    "model",
    [
        "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE",
        "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE",
    ],
)  # fmt: skip
@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_points_land_where_colmap_puts_them(model: str, binary: bool, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera.create_from_model_name(7, model, 310.0, 640, 480)
    rng = np.random.default_rng(3)
    theirs.params = theirs.params * (1 + rng.uniform(-0.02, 0.02, len(theirs.params))) + np.where(
        theirs.params == 0, rng.uniform(-0.02, 0.02, len(theirs.params)), 0.0
    )
    model_of_one = pycolmap.Reconstruction()
    model_of_one.add_camera(theirs)
    (model_of_one.write_binary if binary else model_of_one.write_text)(tmp_path)
    camera = load_camera(tmp_path)
    assert load_camera(tmp_path / f"cameras.{'bin' if binary else 'txt'}", "7") == camera
    points = rng.uniform(-0.7, 0.7, (50, 2))
    expected = theirs.img_from_cam(np.column_stack([points, np.ones(50)]))
    np.testing.assert_allclose(distorted(camera, points), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "model", ["FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "DIVISION", "EUCM"]
)
@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_colmaps_other_models_are_refused_by_name_beside_cameras_that_are_read(
    model: str, binary: bool, tmp_path: Path
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    both = pycolmap.Reconstruction()
    both.add_camera(pycolmap.Camera.create_from_model_name(1, model, 310.0, 640, 480))
    both.add_camera(pycolmap.Camera.create_from_model_name(2, "PINHOLE", 310.0, 640, 480))
    (both.write_binary if binary else both.write_text)(tmp_path)
    message = refused(tmp_path, "1") if not binary else refused(tmp_path / "cameras.bin", "1")
    assert repr(model) in message
    assert re.search("(near ones that are|known): .*(FISHEYE|OPENCV)", message)
    assert load_camera(tmp_path, "2").model == "pinhole"


def test_a_binary_file_cut_off_anywhere_is_refused(tmp_path: Path) -> None:
    whole = colmap_binary(OPENCV)
    for length in range(1, len(whole), 7):
        refused(written(tmp_path, whole[:length]))
    assert "cut off" in refused(written(tmp_path, whole[:-1]))
    assert "behind its last record" in refused(written(tmp_path, whole + b"\0"))


class TestSeveralCameras:
    def test_one_is_asked_for_by_name(self, tmp_path: Path) -> None:
        path = written(tmp_path, kalibr(OPENCV) + kalibr(FISHEYE, "cam1"))
        assert load_camera(path, "cam0").model == "opencv"
        assert load_camera(path, "cam1").model == "fisheye"
        message = refused(path)
        assert "'cam0'" in message
        assert "'cam1'" in message
        assert "'cam1'" in refused(path, "cam2")

    def test_the_command_names_it_behind_a_colon(self, tmp_path: Path) -> None:
        path = written(tmp_path, kalibr(OPENCV) + kalibr(FISHEYE, "cam1"), "a:b.yaml")
        assert parse_camera(f"{path}:cam1") == load_camera(path, "cam1")
        assert camera_file(f"{path}:cam1") == camera_file(str(path)) == path
        assert parse_camera(None) is None
        with pytest.raises(CameraError, match="none:cam1"):
            parse_camera(str(tmp_path / "none:cam1"))

    def test_equal_ones_need_no_name(self, tmp_path: Path) -> None:
        path = written(tmp_path, kalibr(OPENCV) + kalibr(OPENCV, "cam1"))
        assert load_camera(path) == load_camera(path, "cam0")

    def test_an_unknown_lens_beside_it_does_not_matter(self, tmp_path: Path) -> None:
        other = kalibr(OPENCV, "cam1").replace("camera_model: pinhole", "camera_model: omni")
        path = written(tmp_path, kalibr(OPENCV) + other)
        message = refused(path)
        assert "name one of them" in message
        assert "'cam0'" in message
        assert load_camera(path, "cam0").model == "opencv"
        assert "'omni'" in refused(path, "cam1")

    def test_ours_have_a_table_each(self, tmp_path: Path) -> None:
        path = written(tmp_path, f"[left]\n{own(OPENCV)}\n[right]\n{own(FISHEYE)}")
        assert load_camera(path, "right") == FISHEYE
        assert "'left', 'right'" in refused(path)

    def test_frames_have_their_own(self, tmp_path: Path) -> None:
        document = {
            "w": 64, "h": 48, "fl_x": 50.0, "k1": 0.1,
            "frames": [{"file_path": "a.png"}, {"file_path": "b.png", "camera_angle_x": 1.0, "w": 32}],
        }  # fmt: skip
        path = written(tmp_path, json.dumps(document))
        a, b = load_camera(path, "a.png"), load_camera(path, "b.png")
        assert (a.size, a.focal, a.centre) == ((64, 48), (50.0, 50.0), (32.0, 24.0))
        assert b.size == (32, 48)
        assert b.focal[0] == pytest.approx(16.0 / np.tan(0.5))
        assert a.distortion == b.distortion
        refused(path)


class TestTransforms:
    @staticmethod
    def read(tmp_path: Path, **document: object) -> Intrinsics:
        return load_camera(written(tmp_path, json.dumps({"w": 64, "h": 48, "fl_x": 50.0, **document})))

    def test_the_middle_is_the_default_and_fl_x_holds_for_both_axes(self, tmp_path: Path) -> None:
        assert self.read(tmp_path) == Intrinsics((64, 48), (50.0, 50.0), (32.0, 24.0))

    def test_instant_ngps_fisheye(self, tmp_path: Path) -> None:
        camera = self.read(tmp_path, is_fisheye=True, k1=0.1, k4=0.2)
        assert (camera.model, camera.distortion) == ("fisheye", (0.1, 0.0, 0.0, 0.2))

    def test_nerfstudios_k4_is_not_opencvs(self, tmp_path: Path) -> None:
        with pytest.raises(CameraError, match="r⁸"):
            self.read(tmp_path, k1=0.1, k4=0.2)
        full = self.read(tmp_path, camera_model="FULL_OPENCV", k1=0.1, k4=0.2)
        assert dict(zip(LENS_MODELS["opencv"], full.distortion, strict=True))["k4"] == 0.2

    def test_the_size_may_be_the_images(self, tmp_path: Path) -> None:
        from PIL import Image

        Image.new("RGB", (40, 30)).save(tmp_path / "r_0.png")
        document = {"camera_angle_x": 1.0, "frames": [{"file_path": "./r_0"}]}
        camera = load_camera(written(tmp_path, json.dumps(document)))
        assert camera.size == (40, 30)
        assert camera.focal[0] == pytest.approx(20.0 / np.tan(0.5), rel=1e-15)

    @pytest.mark.parametrize(
        ("document", "words"),
        [
            ({"fl_x": float("nan")}, "fl_x is nan"),
            ({"fl_x": "wide"}, "fl_x must be a number"),
            ({"fl_x": 0.0}, "must be positive"),
            ({"w": 64.5}, "whole number"),
            ({"w": 0}, "positive"),
            ({"camera_model": "OPENCV_FISHEY"}, "'OPENCV_FISHEYE', |OPENCV_FISHEYE"),
            ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
            ({"camera_model": "PINHOLE", "k1": 0.1}, "no coefficient k1"),
            ({"frames": 3}, "list of tables"),
            ({"frames": [3]}, "must be a table"),
        ],
    )
    def test_refused(self, document: dict[str, object], words: str, tmp_path: Path) -> None:
        path = written(tmp_path, json.dumps({"w": 64, "h": 48, "fl_x": 50.0, **document}))
        assert re.search(words, refused(path))

    def test_without_a_size_or_a_focal_length(self, tmp_path: Path) -> None:
        assert "w and h" in refused(written(tmp_path, '{"fl_x": 50.0, "frames": []}'))
        assert "fl_x" in refused(written(tmp_path, '{"w": 64, "h": 48, "frames": []}'))


def test_ros_topics_printed_by_ros2(tmp_path: Path) -> None:
    text = """header:
  frame_id: cam
height: 480
width: 640
distortion_model: rational_polynomial
d:
- 0.1
- -1e-2
- 1e-3
- 2.0e-3
- 0.5
- 0.01
- 0.02
- 0.03
k: [500.0, 0.0, 319.5, 0.0, 501.0, 239.5, 0.0, 0.0, 1.0]
binning_x: 0
roi:
  x_offset: 0
  y_offset: 0
---
"""
    camera = load_camera(written(tmp_path, text))
    distortion = (0.1, -0.01, 0.001, 0.002, 0.5, 0.01, 0.02, 0.03)
    assert camera == Intrinsics((640, 480), (500.0, 501.0), (320.0, 240.0), "opencv", distortion)
    assert "region" in refused(written(tmp_path, text.replace("x_offset: 0", "x_offset: 8")))
    assert "binned" in refused(written(tmp_path, text.replace("binning_x: 0", "binning_x: 2")))


def test_inrias_cameras_are_asked_for_by_image(tmp_path: Path) -> None:
    entry = {"id": 0, "img_name": "a", "width": 64, "height": 48, "position": [0, 0, 0]}
    entry.update(rotation=np.eye(3).tolist(), fx=50.0, fy=51.0)
    path = written(tmp_path, json.dumps([entry, {**entry, "img_name": "b", "fx": 60.0}]))
    assert load_camera(path, "b") == Intrinsics((64, 48), (60.0, 51.0), (32.0, 24.0))
    assert "'a', 'b'" in refused(path)


@pytest.mark.parametrize(
    ("form", "old", "new", "words"),
    [
        ("colmap", "OPENCV", "OPENVC", "'OPENVC'.*OPENCV"),
        ("colmap", "752", "0", "positive"),
        ("colmap", "752", "75.2", "known"),
        ("colmap", " 1.7618711400000001e-05", "", "8 parameters.*not 7"),
        ("colmap", "0.073959070000000002", "nan", "is nan"),
        ("opencv_yaml", "image_width", "image_wide", "image_width"),
        ("opencv_yaml", "0., 0., 1.", "0., 1.", "not the 9"),
        ("opencv_yaml", "0., 0., 1.", "0., 0., 2.", "transposed"),
        ("opencv_xml", "opencv_storage", "storage", "opencv_storage"),
        ("opencv_xml", "</opencv_storage>", "", "XML"),
        ("ros", "plumb_bob", "plum_bob", "plumb_bob"),
        ("ros", "data: [4", "data: [a4", "must be a number"),
        ("ros", "data: [4", "data: {4", "YAML"),
        ("kalibr", "radtan", "fov", "'fov'"),
        ("kalibr", "camera_model: pinhole", "camera_model: ds", "'ds'.*pinhole"),
        ("kalibr", "resolution: [752, 480]", "resolution: [752]", "2 numbers"),
        ("kalibr", "  resolution: [752, 480]\n", "", "no resolution"),
        ("own", "k1 =", "k1 = 0.1\nk7 =", "k7"),
        ("own", 'model = "opencv"', 'model = "fisheye"', "no coefficient p1"),
        ("own", 'model = "opencv"', 'model = "openvc"', "opencv"),
        ("own", "size = [752, 480]", "size = [752]", "size must be"),
        ("own", "size = [752, 480]", "", "no size"),
    ],
)
def test_faults_are_named(form: str, old: str, new: str, words: str, tmp_path: Path) -> None:
    text = TEXTS[form](OPENCV)
    assert old in text
    assert re.search(words, refused(written(tmp_path, text.replace(old, new))))


@pytest.mark.parametrize(
    "text", ["", "\n# nothing\n", "hello", "1 2 3", "[]", "{}", "a: b", "<a/>", "\0\1\2", "[a", "x = "]
)
def test_files_of_something_else_are_refused(text: str, tmp_path: Path) -> None:
    refused(written(tmp_path, text))


def test_missing_files_and_empty_folders_are_refused(tmp_path: Path) -> None:
    refused(tmp_path / "none")
    refused(tmp_path)


class TestFilesByOthers:
    def test_colmap(self, captures: Path) -> None:
        camera = load_camera(captures / "lund_door_colmap_12" / "colmap_ground_truth")
        assert (camera.size, camera.focal, camera.centre) == ((1296, 1936), (2435.38, 2435.38), (648, 968))
        assert camera.distortion == (-0.0336422, 0, 0, 0, 0, 0, 0, 0)

    def test_instant_ngp(self, captures: Path) -> None:
        camera = load_camera(captures / "fox_270x480" / "transforms.json")
        assert (camera.size, camera.focal) == ((270, 480), (343.88, 343.6225))
        assert camera.distortion[:4] == (0.0578421, -0.0805099, -0.000980296, 0.00015575)

    def test_nerf(self, captures: Path) -> None:
        camera = load_camera(captures / "nerf_synthetic_lego_train_200" / "transforms_train.json")
        assert (camera.size, camera.centre, camera.model) == ((200, 200), (100.0, 100.0), "pinhole")
        assert camera.focal[0] == pytest.approx(1111.1110311937682 / 4)  # NeRF's loader, of 800 pixels

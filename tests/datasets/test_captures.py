"""Folders of posed photographs: what is found in each format, what is held out, what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from camera_files import distorted, written
from PIL import Image
from pose_files import DOWN, FILES, some_poses

from mitsuba_crb import Capture, Intrinsics, load_camera, load_capture, load_poses
from mitsuba_crb.datasets.intrinsics import cameras_of_poses
from mitsuba_crb.errors import CameraError, CaptureError, MitsubaCRBError, PoseError

COUNT = 10
POSES = some_poses(COUNT)
SIZE = (64, 48)
CAMERA = Intrinsics(SIZE, (50.0, 50.0), (32.0, 24.0))
NAMES = [f"a_{k}.jpg" for k in range(COUNT)]


def photographs(folder: Path, names: list[str] = NAMES, size: tuple[int, int] = SIZE) -> None:
    """Plain images, each of its own grey."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        Image.new("RGB", size, (20 * k, 20 * k, 20 * k)).save(folder / name)


def colmap(folder: Path) -> Path:
    """With points."""
    photographs(folder / "images")
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    written(model, "1 PINHOLE 64 48 50 50 32 24\n", "cameras.txt")
    written(model, FILES["COLMAP text"](POSES).replace("a ", "a_"), "images.txt")
    written(model, "# 3D points\n7 0.5 1.5 2.5 255 0 128 0.3 1 0 2 0\n\n9 1 2 3 1 2 3 0.1\n", "points3D.txt")
    return folder


def transforms(folder: Path, **more: object) -> Path:
    """Beside its images."""
    photographs(folder / "images")
    document = json.loads(FILES["transforms.json"](POSES))
    for k, frame in enumerate(document["frames"]):
        frame["file_path"] = f"images/{NAMES[k]}"
    del document["camera_angle_x"]
    document.update({"fl_x": 50.0, **more})
    written(folder, json.dumps(document), "transforms.json")
    return folder


def llff(folder: Path) -> Path:
    """Of images ten times as large as those that are there."""
    photographs(folder / "images_10")
    written(folder, FILES["LLFF"](POSES), "poses_bounds.npy")
    return folder


def log(folder: Path) -> Path:
    """With a calibration of ours."""
    photographs(folder / "images")
    written(folder, FILES["Tanks and Temples"](POSES), "scene.log")
    written(folder, "size = [64, 48]\nfocal = 50.0\n", "camera.toml")
    return folder


def seven_scenes(folder: Path) -> Path:
    """With depths."""
    folder.mkdir(exist_ok=True)
    photographs(folder, [f"frame-{k:06}.color.png" for k in range(COUNT)])
    for k, pose in enumerate(POSES @ DOWN):
        np.savetxt(folder / f"frame-{k:06}.pose.txt", pose, fmt="%.17g")
        Image.fromarray(np.full((48, 64), 1000, dtype=np.uint16)).save(folder / f"frame-{k:06}.depth.png")
    np.savetxt(folder / "camera-intrinsics.txt", [[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1]])
    return folder


MADE: dict[str, Callable[[Path], Path]] = {
    "COLMAP": colmap,
    "transforms.json": transforms,
    "LLFF": llff,
    "Tanks and Temples": log,
    "7-Scenes": seven_scenes,
}


def refused(path: Path, **options: object) -> str:
    """The line that refuses the capture."""
    with pytest.raises(MitsubaCRBError) as caught:
        load_capture(path, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("form", MADE)
def test_the_same_capture_is_the_same_in_every_format(form: str, tmp_path: Path) -> None:
    capture = load_capture(MADE[form](tmp_path / "capture"))
    assert capture.format == form
    assert len(capture) == COUNT
    for k, photograph in enumerate(capture.photographs):
        np.testing.assert_allclose(photograph.pose, POSES[k], rtol=0, atol=1e-14)
        assert photograph.intrinsics == CAMERA
        assert photograph.colours().mean() == pytest.approx(20 * k / 255, abs=0.01)  # JPEG
        assert photograph.opacity().shape == (48, 64)
    assert (capture.test, capture.train) == ((0, 8), (1, 2, 3, 4, 5, 6, 7, 9))
    assert "every 8th" in capture.split
    assert "every 8th" in str(capture)


class TestCamerasOfPoses:
    @pytest.mark.parametrize("form", [form for form in MADE if form != "Tanks and Temples"])
    def test_one_folder_has_both(self, form: str, tmp_path: Path) -> None:
        folder = MADE[form](tmp_path / "capture")
        poses = load_poses(folder)
        (camera,) = set(cameras_of_poses(folder, poses))
        assert camera == load_camera(folder)
        assert camera.scaled(SIZE) == CAMERA  # LLFF's is of the original images
        np.testing.assert_allclose(poses.poses, POSES, rtol=0, atol=1e-14)

    def test_each_pose_has_its_own(self, tmp_path: Path) -> None:
        folder = colmap(tmp_path / "capture")
        model = folder / "sparse" / "0"
        written(model, "2 PINHOLE 64 48 60 60 32 24\n1 PINHOLE 64 48 50 50 32 24\n", "cameras.txt")
        rows = (model / "images.txt").read_text().splitlines()
        rows = [row.replace(" 1 a_3.jpg", " 2 a_3.jpg") for row in rows]
        (model / "images.txt").write_text("\n".join(rows))
        for path in (folder, model, model / "images.txt"):
            found = cameras_of_poses(path, load_poses(path))
            assert [camera.focal[0] for camera in found] == [60.0 if k == 3 else 50.0 for k in range(COUNT)]
        with pytest.raises(CameraError, match="several different cameras"):
            load_camera(folder)
        written(model, "1 PINHOLE 64 48 50 50 32 24\n", "cameras.txt")
        with pytest.raises(CameraError, match=r"lacks the camera 2 of a pose; it has '1'"):
            cameras_of_poses(folder, load_poses(folder))
        (model / "cameras.txt").unlink()
        assert cameras_of_poses(model / "images.txt", load_poses(model / "images.txt")) == []

    def test_frames_of_transforms_and_rows_of_llff(self, tmp_path: Path) -> None:
        folder = transforms(tmp_path / "one")
        document = json.loads((folder / "transforms.json").read_text())
        document["frames"][2]["fl_x"] = 70.0
        (folder / "transforms.json").write_text(json.dumps(document))
        array = np.load(llff(tmp_path / "other") / "poses_bounds.npy")
        array[2, 14] *= 1.4
        np.save(tmp_path / "other" / "poses_bounds.npy", array)
        for path in (folder, tmp_path / "other"):
            found = [camera.scaled(SIZE).focal[0] for camera in cameras_of_poses(path, load_poses(path))]
            assert found == pytest.approx([70.0 if k == 2 else 50.0 for k in range(COUNT)])

    def test_poses_alone_have_none(self, tmp_path: Path) -> None:
        folder = transforms(tmp_path / "capture")
        document = json.loads((folder / "transforms.json").read_text())
        del document["fl_x"]
        (folder / "transforms.json").write_text(json.dumps(document))
        assert cameras_of_poses(folder, load_poses(folder)) == []
        tum = written(tmp_path, FILES["TUM"](POSES), "path.txt")
        assert cameras_of_poses(tum, load_poses(tum)) == []


@pytest.mark.parametrize("form", MADE)
def test_a_missing_image_is_refused(form: str, tmp_path: Path) -> None:
    folder = MADE[form](tmp_path / "capture")
    sorted(file for file in folder.rglob("*") if re.search(r"a_3\.jpg|3\.color", file.name))[0].unlink()
    assert re.search("1 of 10 images|not as many images|no .color", refused(folder))


@pytest.mark.parametrize("form", ["COLMAP", "transforms.json", "Tanks and Temples"])
def test_images_of_another_size_are_scaled_by_name_or_refused(form: str, tmp_path: Path) -> None:
    folder = MADE[form](tmp_path / "capture")
    half = Intrinsics((32, 24), (25.0, 25.0), (16.0, 12.0))
    photographs(folder / "images_2", size=(32, 24))
    assert load_capture(folder).photographs[0].intrinsics == CAMERA
    assert load_capture(folder, images="images_2").photographs[0].intrinsics == half
    photographs(folder / "images", size=(32, 24))
    assert "rescale=True" in refused(folder)
    scaled = load_capture(folder, rescale=True)
    assert scaled.photographs[0].intrinsics == half
    assert "64x48" in scaled.notes[-1]
    photographs(folder / "images", size=(32, 32))
    assert "another shape" in refused(folder, rescale=True)


class TestColmap:
    def test_points_have_colours(self, tmp_path: Path) -> None:
        capture = load_capture(colmap(tmp_path / "capture"))
        np.testing.assert_array_equal(capture.needed_points(), [[0.5, 1.5, 2.5], [1, 2, 3]])
        np.testing.assert_array_equal(capture.point_colours, [[255, 0, 128], [1, 2, 3]])

    def test_they_may_be_missing_where_nobody_needs_them(self, tmp_path: Path) -> None:
        folder = colmap(tmp_path / "capture")
        (folder / "sparse" / "0" / "points3D.txt").unlink()
        capture = load_capture(folder)
        assert "no points3D" in capture.notes[0]
        with pytest.raises(CaptureError, match="points3D"):
            capture.needed_points()

    def test_binary_points(self, tmp_path: Path) -> None:
        pycolmap = pytest.importorskip("pycolmap")
        folder = colmap(tmp_path / "capture")
        model = folder / "sparse" / "0"
        written(model, (model / "images.txt").read_text().replace("3.5 4.5 7", "3.5 4.5 -1"), "images.txt")
        written(model, "7 0.5 1.5 2.5 255 0 128 0.3\n", "points3D.txt")
        pycolmap.Reconstruction(model).write_binary(model)
        points = model / "points3D.bin"
        np.testing.assert_array_equal(load_capture(folder).points, [[0.5, 1.5, 2.5]])
        whole = points.read_bytes()
        points.write_bytes(whole[:-1])
        assert "cut off" in refused(folder)

    def test_images_are_sorted_by_name(self, tmp_path: Path) -> None:
        folder = colmap(tmp_path / "capture")
        images = folder / "sparse" / "0" / "images.txt"
        rows = [row for row in images.read_text().splitlines() if ".jpg" in row]
        images.write_text("\n\n".join(reversed(rows)) + "\n\n")
        capture = load_capture(folder)
        assert [photograph.name for photograph in capture.photographs] == NAMES
        np.testing.assert_allclose(capture.photographs[2].pose, POSES[2], atol=1e-14)

    @pytest.mark.parametrize("points", ["7 0.5 1.5\n", "7 0.5 1.5 nan 1 2 3 0.1\n", "7 1 2 3 1 2 300 0.1\n"])
    def test_damaged_points_are_refused(self, points: str, tmp_path: Path) -> None:
        folder = colmap(tmp_path / "capture")
        written(folder / "sparse" / "0", points, "points3D.txt")
        assert "line 1" in refused(folder)

    def test_a_camera_that_is_not_there_is_refused(self, tmp_path: Path) -> None:
        folder = colmap(tmp_path / "capture")
        written(folder / "sparse" / "0", "2 PINHOLE 64 48 50 50 32 24\n", "cameras.txt")
        assert "camera 1" in refused(folder)

    def test_the_model_itself_finds_its_images(self, tmp_path: Path) -> None:
        folder = colmap(tmp_path / "capture")
        found = load_capture(folder / "sparse" / "0").photographs[0]
        assert found.image == str(folder / "images" / "a_0.jpg")
        (folder / "images").rename(folder / "photos")
        assert "images" in refused(folder)
        assert len(load_capture(folder, images="photos")) == COUNT


class TestHeldOut:
    def test_nerfstudio_lists_names(self, tmp_path: Path) -> None:
        names = [f"images/{name}" for name in NAMES]
        folder = transforms(tmp_path / "capture", train_filenames=names[3:], test_filenames=names[:3])
        capture = load_capture(folder)
        assert capture.test == (0, 1, 2)
        assert "transforms.json" in capture.split

    def test_nerf_has_a_file_for_each(self, tmp_path: Path) -> None:
        folder = transforms(tmp_path / "capture")
        document = json.loads((folder / "transforms.json").read_text())
        (folder / "transforms.json").unlink()
        for part, frames in (("train", slice(0, 7)), ("test", slice(7, 10))):
            text = json.dumps({**document, "frames": document["frames"][frames]})
            written(folder, text, f"transforms_{part}.json")
        capture = load_capture(folder)
        assert (len(capture.train), capture.test) == (7, (7, 8, 9))
        np.testing.assert_allclose(capture.photographs[8].pose, POSES[8], atol=1e-14)
        (folder / "transforms_test.json").unlink()
        assert load_capture(folder).test == ()


class TestMasks:
    def test_beside_the_images(self, tmp_path: Path) -> None:
        folder = colmap(tmp_path / "capture")
        (folder / "masks").mkdir()
        grey = np.zeros((48, 64), dtype=np.uint8)
        grey[:24] = 255
        Image.fromarray(grey).save(folder / "masks" / "a_1.jpg.png")  # COLMAP's way
        Image.fromarray(grey).save(folder / "masks" / "a_2.png")
        opacity = [photograph.opacity() for photograph in load_capture(folder).photographs]
        assert [o.mean() for o in opacity[:4]] == [1.0, 0.5, 0.5, 1.0]
        assert opacity[1][0, 0] == 1.0

    def test_alpha(self, tmp_path: Path) -> None:
        folder = transforms(tmp_path / "capture")
        Image.new("RGBA", SIZE, (255, 0, 0, 51)).save(folder / "images" / "a_0.jpg", format="PNG")
        photograph = load_capture(folder).photographs[0]
        assert photograph.opacity().max() == pytest.approx(0.2)
        np.testing.assert_array_equal(photograph.colours()[0, 0], [1.0, 0.0, 0.0])

    def test_one_that_is_missing_or_of_another_size_is_refused(self, tmp_path: Path) -> None:
        folder = transforms(tmp_path / "capture")
        document = json.loads((folder / "transforms.json").read_text())
        document["frames"][0]["mask_path"] = "m.png"
        written(folder, json.dumps(document), "transforms.json")
        assert "masks are missing" in refused(folder)
        Image.new("L", (8, 8)).save(folder / "m.png")
        with pytest.raises(CaptureError, match="8x8"):
            load_capture(folder).photographs[0].opacity()


def test_a_calibration_may_be_given(tmp_path: Path) -> None:
    folder = log(tmp_path / "capture")
    (folder / "camera.toml").unlink()
    assert "camera" in refused(folder)
    assert load_capture(folder, camera=CAMERA).photographs[0].intrinsics == CAMERA
    path = written(tmp_path, "1 PINHOLE 64 48 60 60 32 24\n")
    assert load_capture(folder, camera=path).photographs[0].intrinsics.focal == (60.0, 60.0)


def test_folders_without_a_capture_are_refused(tmp_path: Path) -> None:
    assert "known here" in refused(tmp_path)
    assert "No such file" in refused(tmp_path / "none")
    for text in ("", "hello", "{}", "[]", "{"):
        refused(written(tmp_path, text))


def test_images_that_are_none_are_refused(tmp_path: Path) -> None:
    folder = transforms(tmp_path / "capture")
    written(folder / "images", b"hello", "a_3.jpg")
    assert "a_3.jpg" in refused(folder)


def test_damaged_poses_are_named(tmp_path: Path) -> None:
    folder = seven_scenes(tmp_path / "capture")
    np.savetxt(folder / "frame-000002.pose.txt", np.full((4, 4), np.nan))
    with pytest.raises(PoseError, match="frame-000002"):
        load_capture(folder)
    np.savetxt(folder / "frame-000002.pose.txt", np.eye(3))
    with pytest.raises(PoseError, match="frame-000002"):
        load_capture(folder)


class TestCapturesByOthers:
    @pytest.mark.parametrize(
        ("name", "count", "form"),
        [
            ("fox_270x480", 50, "transforms.json"),
            ("nerf_synthetic_lego_train_200", 100, "transforms.json"),
            ("ethiopian_head_llff", 66, "LLFF"),
            ("lund_door_colmap_12", 12, "COLMAP"),
            ("7scenes_redkitchen_40", 40, "7-Scenes"),
        ],
    )
    def test_all_are_read(self, name: str, count: int, form: str, captures: Path) -> None:
        capture = load_capture(captures / name)
        assert (len(capture), capture.format) == (count, form)
        width, height = capture.photographs[0].intrinsics.size
        assert capture.photographs[0].colours().shape == (height, width, 3)
        assert capture.photographs[0].opacity().max() == 1.0

    def test_points_are_seen_where_their_images_show_them(self, captures: Path) -> None:
        pycolmap = pytest.importorskip("pycolmap")
        capture: Capture = load_capture(captures / "lund_door_colmap_12")
        theirs = pycolmap.Reconstruction(captures / "lund_door_colmap_12" / "colmap_ground_truth")
        for photograph in capture.photographs[:3]:
            seen = [p for p in theirs.find_image_with_name(photograph.name).points2D if p.has_point3D()]
            points = np.array([theirs.points3D[p.point3D_id].xyz for p in seen])
            local = (points - photograph.pose[:3, 3]) @ (photograph.pose @ DOWN)[:3, :3]
            film = distorted(photograph.intrinsics, local[:, :2] / local[:, 2:])
            miss = film - np.array([p.xy for p in seen])
            # 0.2 pixels are the model's own error; half a pixel of another origin would show.
            assert np.abs(np.median(miss, axis=0)).max() < 0.05
            assert np.median(np.linalg.norm(miss, axis=1)) < 0.35

    def test_a_depth_map_lies_where_the_next_one_sees_it(self, captures: Path) -> None:
        capture = load_capture(captures / "7scenes_redkitchen_40")
        here, there = capture.photographs[10], capture.photographs[11]
        depths = [np.asarray(Image.open(str(p.depth)), dtype=np.float64) / 1000.0 for p in (here, there)]
        y, x = np.mgrid[0:480:4, 0:640:4]
        z = depths[0][y, x]
        pixels = np.stack([x + 0.5, y + 0.5], axis=-1)
        tangents = (pixels - here.intrinsics.centre) / here.intrinsics.focal
        known = (z > 0.3) & (z < 5.0)
        points = np.concatenate([tangents, np.ones((*z.shape, 1))], axis=-1)[known] * z[known][:, None]
        world = points @ (here.pose @ DOWN)[:3, :3].T + here.pose[:3, 3]
        local = (world - there.pose[:3, 3]) @ (there.pose @ DOWN)[:3, :3]
        film = local[:, :2] / local[:, 2:] * there.intrinsics.focal + there.intrinsics.centre
        inside = (local[:, 2] > 0.1) & (film > 0).all(axis=1) & (film < there.intrinsics.size).all(axis=1)
        column, row = np.floor(film[inside]).astype(int).T
        measured = depths[1][row, column]
        off = (local[inside, 2] - measured)[(measured > 0.3) & (measured < 5.0)]
        assert len(off) > 3000
        assert np.median(np.abs(off)) < 0.02

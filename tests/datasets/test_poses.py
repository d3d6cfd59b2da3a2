"""Poses by other tools: the same ones in every format, files by others, and what is refused in one line."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from camera_files import written
from pose_files import DOWN, FILES, array, colmap_binary, euroc, kitti, some_poses, transforms, tum
from scipy.spatial.transform import Rotation

from mitsuba_crb import load_poses, se3
from mitsuba_crb.datasets.body_from_camera import load_body_from_camera
from mitsuba_crb.errors import PoseError

POSES = some_poses()
TEXTS = [form for form, write in FILES.items() if isinstance(write(POSES), str)]


def refused(path: Path, convention: str | None = None) -> str:
    """The line that refuses the file."""
    with pytest.raises(PoseError) as caught:
        load_poses(path, convention)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


@pytest.mark.parametrize("form", FILES)
def test_the_same_poses_are_the_same_in_every_format(form: str, tmp_path: Path) -> None:
    read = load_poses(written(tmp_path, FILES[form](POSES)))
    # quaternions and inverses round the last digits
    np.testing.assert_allclose(read.poses, POSES, rtol=0, atol=1e-14)
    assert len(read) == len(read.names) == len(POSES)
    assert not read.notes
    if form not in ("npy of 3x4", "npy", "JSON", "16 numbers", "4x4"):
        assert read.format.split()[0] == form.split(maxsplit=1)[0] or form == "INRIA"


@pytest.mark.parametrize("form", TEXTS)
def test_windows_line_ends_a_byte_order_mark_and_blank_ends_change_nothing(form: str, tmp_path: Path) -> None:
    text = FILES[form](POSES)
    plain = load_poses(written(tmp_path, text))
    for other in ("\ufeff" + text.replace("\n", "\r\n"), text.rstrip(), text + "\n\n  \n"):
        read = load_poses(written(tmp_path, other.encode()))
        np.testing.assert_array_equal(read.poses, plain.poses)
        assert (read.names, read.convention) == (plain.names, plain.convention)


@pytest.mark.parametrize("form", ["TUM", "KITTI", "16 numbers", "4x4", "Tanks and Temples"])
def test_rows_may_have_commas_tabs_comments_and_blank_lines(form: str, tmp_path: Path) -> None:
    text = FILES[form](POSES)
    plain = load_poses(written(tmp_path, text))
    rows = [row for row in text.splitlines() if not row.startswith("#")]
    others = [
        "\n".join(re.sub(" +", ", ", row.strip()) for row in rows),
        "\n".join(row.replace(" ", "\t") for row in rows),
        "# one\n\n" + "\n# between\n\n".join(rows),
        "\n".join("  " + row + "  \t" for row in rows),
    ]
    for other in others:
        read = load_poses(written(tmp_path, other))
        np.testing.assert_array_equal(read.poses, plain.poses)
        assert read.names == plain.names


class TestTimeStamps:
    def test_every_digit_is_kept(self, tmp_path: Path) -> None:
        read = load_poses(written(tmp_path, tum(POSES)))
        assert read.names[:2] == ("1403636579.758555390", "1403636579.758555391")
        assert load_poses(written(tmp_path, euroc(POSES))).names[0] == "1403636579758555390"

    def test_there_may_be_none(self, tmp_path: Path) -> None:
        rows = [row.split(" ", 1)[1] for row in tum(POSES).splitlines()[2:]]
        read = load_poses(written(tmp_path, "\n".join(rows)))
        np.testing.assert_allclose(read.poses, POSES, rtol=0, atol=1e-14)
        assert read.names == ("0", "1", "2", "3", "4")

    @pytest.mark.parametrize("stamp", ["today", "nan", "inf", "12:30:01"])
    def test_those_that_are_no_numbers_are_refused(self, stamp: str, tmp_path: Path) -> None:
        text = tum(POSES).replace("1403636579.758555392", stamp)
        assert "line 5" in refused(written(tmp_path, text))


class TestQuaternionOrder:
    HEADER = "# timestamp tx ty tz qx qy qz qw"

    def test_a_header_that_contradicts_tum_is_refused_unless_confirmed(self, tmp_path: Path) -> None:
        text = tum(POSES).replace("qx qy qz qw", "qw qx qy qz")
        path = written(tmp_path, text)
        assert "w x y z" in refused(path)
        w_first = load_poses(path, "wxyz")
        row = text.splitlines()[2].split()
        by_hand = se3.pose_from_vector([float(word) for word in (*row[1:4], *row[5:8], row[4])]) @ DOWN
        np.testing.assert_allclose(w_first.poses[0], by_hand, atol=1e-14)
        assert "x y z w" in refused(path, "xyzw")

    def test_a_header_that_contradicts_euroc_is_refused_unless_confirmed(self, tmp_path: Path) -> None:
        names = [f"q_RS_{axis} []" for axis in "wxyz"]
        text = euroc(POSES).replace(", ".join(names), ", ".join([*names[1:], names[0]]))
        path = written(tmp_path, text)
        assert "EuRoC" in refused(path)
        assert len(load_poses(path, "xyzw")) == 5

    def test_a_csv_says_it_in_its_first_row(self, tmp_path: Path) -> None:
        rows = [row.split() for row in tum(POSES).splitlines()[2:]]
        head = "time,qw,qx,qy,qz,x,y,z"
        text = [head, *(",".join([r[0], r[7], *r[4:7], *r[1:4]]) for r in rows)]
        read = load_poses(written(tmp_path, "\n".join(text)))
        np.testing.assert_allclose(read.poses, POSES, rtol=0, atol=1e-14)
        assert "w x y z" in read.convention

    def test_ros_names_are_understood(self, tmp_path: Path) -> None:
        rows = [row.split() for row in tum(POSES).splitlines()[2:]]
        parts = [*(f"position.{a}" for a in "xyz"), *(f"orientation.{a}" for a in "xyzw")]
        names = [f"field.pose.pose.{part}" for part in parts]
        text = [",".join(["%time", *names]), *(",".join(row) for row in rows)]
        read = load_poses(written(tmp_path, "\n".join(text)))
        np.testing.assert_allclose(read.poses, POSES, rtol=0, atol=1e-14)

    def test_euroc_without_a_header_needs_the_convention(self, tmp_path: Path) -> None:
        path = written(tmp_path, "\n".join(euroc(POSES).splitlines()[1:]))
        assert "xyzw or wxyz" in refused(path)
        np.testing.assert_allclose(load_poses(path, "wxyz").poses, POSES, rtol=0, atol=1e-14)

    def test_a_header_of_another_number_of_columns_is_refused(self, tmp_path: Path) -> None:
        assert "8 columns" in refused(written(tmp_path, f"{self.HEADER}\n1 2 3 0 0 0 1\n"))

    def test_colmaps_header_counts_too(self, tmp_path: Path) -> None:
        text = FILES["COLMAP text"](POSES).replace("QW, QX, QY, QZ", "QX, QY, QZ, QW")
        assert "qw last" in refused(written(tmp_path, text))

    def test_a_negative_w_is_the_same_rotation(self, tmp_path: Path) -> None:
        a = load_poses(written(tmp_path, "0 1 2 3 0.1 0.7 -0.1 0.7\n"))
        b = load_poses(written(tmp_path, "0 1 2 3 -0.1 -0.7 0.1 -0.7\n"))
        np.testing.assert_allclose(a.poses, b.poses, atol=1e-15)


class TestConvention:
    @pytest.mark.parametrize(
        ("words", "turned"),
        [
            ("mitsuba", np.eye(4)),
            ("opencv", np.diag([-1.0, -1.0, 1.0, 1.0])),
            ("OpenGL world_from_camera", np.diag([-1.0, 1.0, -1.0, 1.0])),
        ],
    )
    def test_arrays_are_ours_unless_it_says_otherwise(
        self, words: str, turned: np.ndarray, tmp_path: Path
    ) -> None:
        read = load_poses(written(tmp_path, array(POSES @ turned)), words)
        np.testing.assert_allclose(read.poses, POSES, atol=1e-15)
        assert words.split(maxsplit=1)[0].lower() in read.convention
        assert "as given" in read.convention

    def test_the_inverse(self, tmp_path: Path) -> None:
        inverses = np.linalg.inv(POSES @ DOWN)
        read = load_poses(written(tmp_path, kitti(POSES)))
        path = written(tmp_path, array(inverses))
        np.testing.assert_allclose(
            load_poses(path, "opencv, camera_from_world").poses, read.poses, rtol=0, atol=1e-14
        )

    def test_it_may_contradict_custom_but_no_definition(self, tmp_path: Path) -> None:
        path = written(tmp_path, kitti(POSES))
        np.testing.assert_allclose(load_poses(path, "mitsuba").poses, POSES @ DOWN, atol=1e-14)
        for form in ("transforms.json", "COLMAP text", "COLMAP binary", "LLFF", "INRIA"):
            assert "mitsuba" in refused(written(tmp_path, FILES[form](POSES)), "mitsuba")
        path = written(tmp_path, transforms(POSES))
        np.testing.assert_array_equal(load_poses(path, "opengl").poses, load_poses(path).poses)

    @pytest.mark.parametrize(
        ("words", "reason"),
        [("opencvv", "opencv"), ("ros", "known are"), ("opencv opengl", "both"), ("xyzw", "no quaternions")],
    )
    def test_refused(self, words: str, reason: str, tmp_path: Path) -> None:
        with pytest.raises(PoseError, match=reason):
            load_poses(written(tmp_path, array(POSES)), words)

    @pytest.mark.parametrize("form", FILES)
    def test_what_was_read_is_said(self, form: str, tmp_path: Path) -> None:
        read = load_poses(written(tmp_path, FILES[form](POSES)))
        assert re.search("(world_from_camera|camera_from_world), camera axes x", read.convention)
        assert read.convention in str(read)
        assert ("body" in read.convention) == (form == "EuRoC")


class TestBody:
    BODY_FROM_CAMERA = se3.exp([0.1, -0.2, 0.3, 1.0, -2.0, 0.5])

    @pytest.mark.parametrize("form", ["EuRoC", "TUM"])
    def test_its_poses_are_carried_to_the_camera(self, form: str, tmp_path: Path) -> None:
        bodies = POSES @ DOWN @ np.linalg.inv(self.BODY_FROM_CAMERA) @ DOWN
        read = load_poses(written(tmp_path, FILES[form](bodies)), body_from_camera=self.BODY_FROM_CAMERA)
        np.testing.assert_allclose(read.poses, POSES, rtol=0, atol=1e-14)
        assert "carried to its camera" in read.convention

    def test_of_the_inverse_too(self, tmp_path: Path) -> None:
        inverses = np.linalg.inv(POSES @ np.linalg.inv(self.BODY_FROM_CAMERA))
        path = written(tmp_path, array(inverses))
        read = load_poses(path, "mitsuba camera_from_world", body_from_camera=self.BODY_FROM_CAMERA)
        np.testing.assert_allclose(read.poses, POSES, rtol=0, atol=1e-14)

    def test_a_calibration_s_camera_has_opencv_s_axes_whatever_holds_the_bodies(self, tmp_path: Path) -> None:
        bodies = POSES @ DOWN @ np.linalg.inv(self.BODY_FROM_CAMERA)
        read = load_poses(written(tmp_path, array(bodies)), body_from_camera=self.BODY_FROM_CAMERA)
        np.testing.assert_allclose(read.poses, POSES, rtol=0, atol=1e-14)
        assert "(opencv)" in read.convention

    def test_it_is_read_from_files(self, tmp_path: Path) -> None:
        B = self.BODY_FROM_CAMERA
        numbers = ", ".join(f"{value:.17g}" for value in B.ravel())
        np.save(tmp_path / "b.npy", B)
        vector = [*B[:3, 3], *Rotation.from_matrix(B[:3, :3]).as_quat()]
        files = {
            "sensor.yaml": f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\nrate_hz: 20",
            "b.txt": "\n".join(" ".join(f"{value:.17g}" for value in row) for row in B),
            "b.json": json.dumps(B.tolist()),
            "v.txt": " ".join(f"{value:.17g}" for value in vector),
        }
        for path in [tmp_path / "b.npy", *(written(tmp_path, text, name) for name, text in files.items())]:
            np.testing.assert_allclose(load_body_from_camera(path), B, rtol=0, atol=1e-14)

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("rate_hz: 20", "T_BS"),
            ("T_BS: {rows: 4}", "4x4"),
            ("T_BS: {data: [1, 2, 3]}", "got 3 numbers"),
            ("T_BS: 3", "got 1 numbers"),
            ("2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "scale"),
            ("", "T_BS"),
            ("{", "YAML"),
        ],
    )
    def test_a_file_without_it_is_named(self, text: str, words: str, tmp_path: Path) -> None:
        path = written(tmp_path, text, "sensor.yaml")
        with pytest.raises(PoseError, match=rf"sensor\.yaml.*{words}") as caught:
            load_body_from_camera(path)
        assert "\n" not in str(caught.value)

    def test_cameras_own_poses_need_none(self, tmp_path: Path) -> None:
        for form in ("COLMAP text", "LLFF", "INRIA", "transforms.json"):
            with pytest.raises(PoseError, match="leave body_from_camera out"):
                load_poses(written(tmp_path, FILES[form](POSES)), body_from_camera=self.BODY_FROM_CAMERA)
        with pytest.raises(PoseError, match="body_from_camera contains a scale"):
            load_poses(written(tmp_path, euroc(POSES)), body_from_camera=np.diag([2.0, 2.0, 2.0, 1.0]))


class TestNerfstudio:
    APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0.5]])

    def document(self) -> dict[str, object]:
        A = np.vstack([self.APPLIED, [0, 0, 0, 1]])
        moved = A @ POSES
        moved[:, :3, 3] *= 0.25
        document = json.loads(transforms(moved))
        return {**document, "applied_transform": self.APPLIED.tolist(), "applied_scale": 0.25}

    def test_applied_transform_is_undone(self, tmp_path: Path) -> None:
        read = load_poses(written(tmp_path, json.dumps(self.document())))
        np.testing.assert_allclose(read.poses, POSES, atol=1e-14)
        assert "before applied_transform" in read.convention

    def test_the_trained_models_world(self, tmp_path: Path) -> None:
        T = se3.exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
        parser = written(tmp_path, json.dumps({"transform": T[:3].tolist(), "scale": 0.5}), "parser.json")
        path = written(tmp_path, json.dumps(self.document()))
        expected = T @ POSES
        expected[:, :3, 3] *= 0.5
        read = load_poses(path, dataparser=parser)
        np.testing.assert_allclose(read.poses, expected, atol=1e-14)
        assert "parser.json" in read.convention
        with pytest.raises(PoseError, match=r"leave .* out"):
            load_poses(written(tmp_path, json.dumps(POSES.tolist()), "list.json"), dataparser=parser)
        parser.rename(tmp_path / "dataparser_transforms.json")
        np.testing.assert_array_equal(load_poses(path).poses, read.poses)

    @pytest.mark.parametrize(
        ("key", "value"),
        [
            ("applied_scale", 0),
            ("applied_transform", [[1, 2], [3, 4]]),
            ("applied_transform", (2 * np.eye(4)).tolist()),
        ],
    )
    def test_refused(self, key: str, value: object, tmp_path: Path) -> None:
        assert key in refused(written(tmp_path, json.dumps({**self.document(), key: value})))


class TestColmap:
    def test_a_model_is_read_as_colmap_reads_it(self, tmp_path: Path) -> None:
        pycolmap = pytest.importorskip("pycolmap")
        written(tmp_path, "1 PINHOLE 640 480 500 500 320 240\n", "cameras.txt")
        text = FILES["COLMAP text"](POSES).replace("3.5 4.5 7", "3.5 4.5 -1")
        written(tmp_path, text.replace("a ", "a_"), "images.txt")  # COLMAP cuts names at blanks
        written(tmp_path, "", "points3D.txt")
        theirs = pycolmap.Reconstruction(tmp_path)
        read = load_poses(tmp_path)
        for name, pose in zip(read.names, read.poses, strict=True):
            image = theirs.find_image_with_name(name)
            expected = se3.pose_from_colmap(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))
            np.testing.assert_allclose(pose, expected, rtol=0, atol=1e-13)
        (tmp_path / "sparse" / "0").mkdir(parents=True)
        theirs.write_binary(tmp_path / "sparse" / "0")
        again = load_poses(tmp_path / "sparse" / "0")
        order = [read.names.index(name) for name in again.names]
        np.testing.assert_allclose(again.poses, read.poses[order], rtol=0, atol=1e-14)
        for name in ("cameras", "images", "points3D"):
            (tmp_path / f"{name}.txt").unlink()
        np.testing.assert_array_equal(load_poses(tmp_path).poses, again.poses)

    def test_images_may_have_no_line_of_points_at_all(self, tmp_path: Path) -> None:
        lines = [row for row in FILES["COLMAP text"](POSES).splitlines() if ".jpg" in row]
        read = load_poses(written(tmp_path, "\n".join(lines)))
        assert read.names == tuple(f"a {k}.jpg" for k in range(5))
        assert read.cameras == ("1",) * 5

    def test_a_binary_file_cut_off_anywhere_is_refused(self, tmp_path: Path) -> None:
        whole = colmap_binary(POSES)
        for length in range(1, len(whole), 13):
            refused(written(tmp_path, whole[:length]))
        assert "cut off" in refused(written(tmp_path, whole[:-1]))

    def test_a_folder_that_lacks_a_file_is_refused(self, tmp_path: Path) -> None:
        assert "no COLMAP model" in refused(tmp_path)
        written(tmp_path, "1 PINHOLE 640 480 500 500 320 240\n", "cameras.txt")
        assert "no images.txt" in refused(tmp_path)

    def test_twice_the_same_image_is_refused(self, tmp_path: Path) -> None:
        text = FILES["COLMAP text"](POSES)
        assert "'a 0.jpg'" in refused(written(tmp_path, text.replace("a 1.jpg", "a 0.jpg")))


def test_llffs_images_are_named_by_their_sorted_order(tmp_path: Path) -> None:
    path = written(tmp_path, FILES["LLFF"](POSES), "poses_bounds.npy")
    assert load_poses(path).names == ("0", "1", "2", "3", "4")
    (tmp_path / "images").mkdir()
    for name in "ecdab":
        written(tmp_path / "images", "", f"{name}.JPG")
    assert load_poses(path).names == ("a.JPG", "b.JPG", "c.JPG", "d.JPG", "e.JPG")


def test_rounded_text_is_mended_and_said(tmp_path: Path) -> None:
    rounded = "".join(" ".join(f"{value:.4f}" for value in p.ravel()) + "\n" for p in POSES)
    read = load_poses(written(tmp_path, rounded))
    np.testing.assert_allclose(read.poses, POSES, atol=2e-4)
    rotations = read.poses[:, :3, :3]
    products = rotations @ np.swapaxes(rotations, 1, 2)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (5, 1, 1)), atol=1e-14)
    assert "rounding" in read.notes[0]


MIRRORED = POSES @ np.diag([1.0, 1.0, -1.0, 1.0])
SCALED = POSES @ np.diag([1.01, 1.01, 1.01, 1.0])


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        (MIRRORED, "reflection"),
        (SCALED, "scale"),
        (np.swapaxes(POSES, 1, 2), "transposed"),
        (POSES * np.nan, "NaN|nan|number"),
    ],
    ids=["mirrored", "scaled", "transposed", "NaN"],
)
@pytest.mark.parametrize("form", ["16 numbers", "npy", "JSON", "4x4", "Tanks and Temples", "transforms.json"])
def test_what_is_no_rigid_motion_is_refused(form: str, poses: np.ndarray, words: str, tmp_path: Path) -> None:
    assert re.search(words, refused(written(tmp_path, FILES[form](poses))))


@pytest.mark.parametrize("form", ["KITTI", "LLFF", "INRIA"])
@pytest.mark.parametrize("poses", [MIRRORED, SCALED], ids=["mirrored", "scaled"])
def test_no_rotation_is_no_rotation_without_a_last_row(form: str, poses: np.ndarray, tmp_path: Path) -> None:
    refused(written(tmp_path, FILES[form](poses)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0 1 2 3 0 0 0 0\n", "length 0"),
        ("0 1 2 3 0 0 0 1.01\n", "length 1.01"),
        ("0 1 2 3 1 1 1 1\n", "length 2"),
        ("0 1 2 3 0 0 nan 1\n", "nan"),
        ("0 1 2 inf 0 0 0 1\n", "inf"),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0\n", "line 2 has 7 numbers"),
        ("0 1 2 3 0 0 0 1\n1 0 0 0 0 1 0 0 0 0 1 0\n", "line 2 has 12 numbers"),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 x\n", "line 2.*'x'"),
        ("0 1 2 3 0 0 0 x\n1 1 2 3 0 0 0 1\n", "line 1.*'x'"),
        ("0 1 2 3 0 0 0 1\ntime x y z qx qy qz qw\n", "line 2.*'time'"),
        ("0 1 2 3 0 0 0 1\n0 1 2 3,, 0 0 1\n", "line 2.*''"),
        ("1 2\n", "2 numbers"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n", "no whole 4x4"),
        ("0 0 0\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 1 0\n1 0 0 0\n", "line 6"),
        ("# only\n", "empty"),
        ("", "empty"),
        ("\n\n", "empty"),
        ("time x y z qx qy qz qw\n", "no rows of numbers"),
        ("hello world\n", "no rows of numbers"),
        ("image_width: 640\nimage_height: 480\n", "known are .*TUM"),
        ("[]", "shape"),
        ("[1, 2", "JSON"),
        ("[{}]", "known"),
        ("{}", "known"),
        ('{"frames": []}', "no frame"),
        ('{"frames": [{"file_path": "a"}]}', "transform_matrix"),
        ('{"frames": [{"transform_matrix": [[1, 0], [0, 1]]}]}', "matrix"),
        ('{"frames": [{"transform_matrix": [[1, 0, 0, "a"], [0, 1, 0, 0], [0, 0, 1, 0]]}]}', "'a'"),
        ('[{"rotation": [[1, 0, 0]], "position": [0, 0, 0]}]', "rotation"),
        ('[{"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "position": [0, 0]}]', "position"),
        ("1 PINHOLE 640 480 500 500 320 240\n", "cameras, not poses"),
        ("1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 0 0 0 1\n", "10|got 9 words|expected"),
        ("1 0 0 0 0 0 0 0 1 a.jpg\n", "length 0"),
        ("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n1 1 0 0 0 0 0 0 1\n", "got 9 words"),
        ("\0\1\2\3\4\5\6\7\0\1\2\3\4", "cut off|known"),
    ],
)  # fmt: skip
def test_faults_are_named(text: str, words: str, tmp_path: Path) -> None:
    assert re.search(words, refused(written(tmp_path, text)))


def test_arrays_of_another_shape_are_refused(tmp_path: Path) -> None:
    for values in (np.eye(3), np.zeros((0, 4, 4)), np.zeros((2, 5, 5)), np.zeros(16), np.zeros((3, 4, 4, 4))):
        assert "shape" in refused(written(tmp_path, array(values)))
    refused(written(tmp_path, array(POSES)[:-8]))
    refused(written(tmp_path, array(POSES.astype(complex))))


class TestFilesByOthers:
    def test_colmap(self, captures: Path) -> None:
        read = load_poses(captures / "lund_door_colmap_12" / "colmap_ground_truth")
        assert read.names[0] == "DSC_0001.JPG"
        R = read.poses[0, :3, :3] @ DOWN[:3, :3]
        np.testing.assert_allclose(R.T @ read.poses[0, :3, 3], [7.60712, -0.428157, -2.75243], atol=1e-6)

    def test_colmaps_points_are_seen_where_the_image_has_them(self, captures: Path) -> None:
        pycolmap = pytest.importorskip("pycolmap")
        folder = captures / "lund_door_colmap_12" / "colmap_ground_truth"
        read = load_poses(folder)
        theirs = pycolmap.Reconstruction(folder)
        for name, pose in zip(read.names, read.poses, strict=True):
            image = theirs.find_image_with_name(name)
            expected = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
            np.testing.assert_allclose(np.linalg.inv(pose @ DOWN), expected, atol=1e-5)

    def test_instant_ngp(self, captures: Path) -> None:
        read = load_poses(captures / "fox_270x480" / "transforms.json")
        assert len(read) == 50
        # All photographs are of the fox, which stands about the world's origin.
        towards = -read.poses[:, :3, 3] / np.linalg.norm(read.poses[:, :3, 3], axis=1, keepdims=True)
        assert (np.einsum("ni,ni->n", read.poses[:, :3, 2], towards) > 0.8).all()

    def test_nerf(self, captures: Path) -> None:
        read = load_poses(captures / "nerf_synthetic_lego_train_200")
        towards = -read.poses[:, :3, 3] / np.linalg.norm(read.poses[:, :3, 3], axis=1, keepdims=True)
        np.testing.assert_allclose(read.poses[:, :3, 2], towards, atol=1e-5)
        assert (read.poses[:, 2, 1] > 0.0).all()  # y is up

    def test_llff(self, captures: Path) -> None:
        read = load_poses(captures / "ethiopian_head_llff" / "poses_bounds.npy")
        assert (len(read), read.names[0]) == (66, "DSC_0007.jpg")
        # All cameras look at one head, whose middle is between the nearest and the farthest of its points.
        c, d = read.poses[:, :3, 3], read.poses[:, :3, 2]
        across = np.eye(3) - d[:, :, None] * d[:, None, :]
        centre = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, c))
        bounds = np.load(captures / "ethiopian_head_llff" / "poses_bounds.npy")[:, 15:]
        depth = np.einsum("ni,ni->n", centre - c, d)
        assert (depth > bounds[:, 0]).all()
        assert (np.median(depth / bounds[:, 0]) > 1.0) & (np.median(depth / bounds[:, 1]) < 1.0)
        miss = np.linalg.norm(np.einsum("nij,nj->ni", across, centre - c), axis=1)
        assert (miss < 0.15 * depth).all()

    def test_seven_scenes(self, captures: Path) -> None:
        path = captures / "7scenes_redkitchen_40" / "frame-000025.pose.txt"
        read = load_poses(path, "opencv")
        assert read.poses[0, :3, 3] == pytest.approx([-0.370651960, 0.0042487988, 0.3094472])


def test_whole_numbers_of_kitti_are_no_image_of_colmap(tmp_path: Path) -> None:
    """Whose name, behind a number, a quaternion, a place and a camera's number, may have blanks."""
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 3 0 1 0 0 0 0 1 0\n")
    read = load_poses(path)
    assert read.format == "KITTI"
    np.testing.assert_array_equal(read.poses[:, :3, 3], [[0, 0, 0], [3, 0, 0]])

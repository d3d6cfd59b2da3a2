"""The same poses in the words of other tools, with 17 digits; each by formulas of its own."""

from __future__ import annotations

import io
import json
import struct

import numpy as np
from scipy.spatial.transform import Rotation

from mitsuba_crb import se3

DOWN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Axes x right, y down, z forward seen from ours."""
BACK = np.diag([-1.0, 1.0, -1.0, 1.0])
"""Axes x right, y up, z back seen from ours."""


def some_poses(count: int = 5) -> np.ndarray:
    """Ours, world_from_camera, of any attitude."""
    return np.array([se3.exp(xi) for xi in np.random.default_rng(8).normal(0.0, 1.5, (count, 6))])


def line(numbers: object) -> str:
    """Numbers with 17 digits."""
    return " ".join(f"{value:.17g}" for value in np.ravel(np.asarray(numbers)))


def quaternion(pose: np.ndarray) -> np.ndarray:
    """x, y, z, w; of either sign, as both are used."""
    q = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return -q if pose[0, 3] > 0.0 else q


def tum(poses: np.ndarray) -> str:
    """With the time stamps of EuRoC."""
    rows = [
        f"1403636579.75855539{k} {line(p[:3, 3])} {line(quaternion(p))} " for k, p in enumerate(poses @ DOWN)
    ]
    return "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n"


def kitti(poses: np.ndarray) -> str:
    """Twelve numbers a row."""
    return "".join(f"{line(p[:3])}\n" for p in poses @ DOWN)


def euroc(poses: np.ndarray) -> str:
    """With velocities and biases."""
    head = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
        "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], "
        "b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], "
        "b_a_RS_S_z [m s^-2]\n"
    )
    rows = [
        f"140363657975855539{k} {line(p[:3, 3])} {line(np.roll(quaternion(p), 1))} {line(np.arange(9) / 7)}"
        for k, p in enumerate(poses @ DOWN)
    ]
    return head + "".join(row.replace(" ", ",") + "\n" for row in rows)


def colmap_text(poses: np.ndarray) -> str:
    """`images.txt`; every second image has no points."""
    rows = []
    for k, p in enumerate(poses):
        cam_from_world = np.linalg.inv(p @ DOWN)
        q = np.roll(quaternion(cam_from_world), 1)
        points = "" if k % 2 else "1.5 2.5 -1 3.5 4.5 7"
        rows.append(f"{k + 1} {line(q)} {line(cam_from_world[:3, 3])} 1 a {k}.jpg\n{points}\n")
    return "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[]\n" + "".join(rows)


def colmap_binary(poses: np.ndarray) -> bytes:
    """`images.bin`."""
    data = struct.pack("<Q", len(poses))
    for k, p in enumerate(poses):
        cam_from_world = np.linalg.inv(p @ DOWN)
        q = np.roll(quaternion(cam_from_world), 1)
        data += struct.pack("<I7dI", k + 1, *q, *cam_from_world[:3, 3], 1) + f"a {k}.jpg".encode() + b"\0"
        data += struct.pack("<Q", k) + k * struct.pack("<ddq", 1.5, 2.5, -1)
    return data


def transforms(poses: np.ndarray) -> str:
    """`transforms.json`."""
    frames = [{"file_path": f"a {k}.jpg", "transform_matrix": p.tolist()} for k, p in enumerate(poses @ BACK)]
    return json.dumps({"camera_angle_x": 1.0, "w": 64, "h": 48, "frames": frames})


def array(values: np.ndarray) -> bytes:
    """As `numpy.save` writes it."""
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def llff(poses: np.ndarray) -> bytes:
    """`poses_bounds.npy`."""
    right, up, back, centre = np.moveaxis((poses @ BACK)[:, :3], 2, 0)
    size = np.broadcast_to([480.0, 640.0, 500.0], (len(poses), 3))
    matrices = np.stack([-up, right, back, centre, size], axis=2).reshape(-1, 15)
    return array(np.concatenate([matrices, np.tile([1.0, 10.0], (len(poses), 1))], axis=1))


def inria(poses: np.ndarray) -> str:
    """`cameras.json`."""
    return json.dumps(
        [
            {
                "id": k,
                "img_name": f"a {k}.jpg",
                "width": 64,
                "height": 48,
                "position": p[:3, 3].tolist(),
                "rotation": p[:3, :3].tolist(),
                "fy": 50.0,
                "fx": 50.0,
            }
            for k, p in enumerate(poses @ DOWN)
        ]
    )


def log(poses: np.ndarray) -> str:
    """Tanks and Temples' `.log`."""
    blocks = [f"{k} {k} 0\n" + "".join(f"{line(row)}\n" for row in p) for k, p in enumerate(poses @ DOWN)]
    return "".join(blocks)


FILES = {
    "TUM": tum,
    "KITTI": kitti,
    "EuRoC": euroc,
    "COLMAP text": colmap_text,
    "COLMAP binary": colmap_binary,
    "transforms.json": transforms,
    "LLFF": llff,
    "INRIA": inria,
    "Tanks and Temples": log,
    "npy": array,
    "npy of 3x4": lambda poses: array(poses[:, :3]),
    "JSON": lambda poses: json.dumps(poses.tolist()),
    "16 numbers": lambda poses: "".join(f"{line(p)}\n" for p in poses),
    "4x4": lambda poses: "\n".join(f"{line(row)}" for p in poses for row in p),
}
"""By format."""

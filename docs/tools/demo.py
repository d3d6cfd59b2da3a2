"""Files to try the how-tos with, in the place of your own, all of the shipped sitting room.

    python docs/tools/demo.py calibration   # camera.yaml, as OpenCV writes it
    python docs/tools/demo.py trajectory    # walk.txt, as SLAM systems write it (TUM)
    python docs/tools/demo.py photo         # photo.png, seen from a little beside the scene's camera
    python docs/tools/demo.py capture       # capture/, posed photographs with their transforms.json
    python docs/tools/demo.py splats        # splats/, a file of Gaussian splats with its cameras.json

They are written into the folder that the command runs in; another size of the images is `--size WxH`.
"""

from __future__ import annotations

import argparse
import functools
import json
from pathlib import Path

import mitsuba_crb  # isort: split

import mitsuba as mi
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

ROOM = Path(__file__).parents[2] / "scenes" / "textured_room" / "textured_room.xml"
WHITE = 0.6  # the radiance that is 255 in a photograph
FOV = 64.0  # the room's camera's, along x [deg]
VIEWS = 32
PATHS = 64  # per pixel
# Camera axes: ours are x left, y up, z forward; these are what others have.
OPENGL, OPENCV = np.diag([-1.0, 1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])

CALIBRATION = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 460.2, 0., 322.4, 0., 461.0, 236.8, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.28, 0.07, 0.0002, -0.0001, 0. ]
"""


def looking(origin: np.ndarray, target: np.ndarray) -> np.ndarray:
    """world_from_camera in our axes, upright."""
    forward = (target - origin) / np.linalg.norm(target - origin)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    pose = np.eye(4)
    pose[:3] = np.column_stack([left, np.cross(forward, left), forward, origin])
    return pose


def calibration(_: tuple[int, int]) -> None:
    """A lens with barrel distortion."""
    Path("camera.yaml").write_text(CALIBRATION)


def trajectory(_: tuple[int, int]) -> None:
    """From the room's middle towards the wall with the picture, turning to look at it from near."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for s in np.linspace(0.0, 1.0, 12):
        origin = np.array([0.8 - 1.4 * s, -0.6 + 2.2 * s, 1.5])
        target = np.array([-0.2 - 2.2 * s, 3.8 - 0.6 * s, 0.9 + 0.6 * s])
        pose = looking(origin, target) @ OPENCV
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines.append(f"{10 * s:.3f} " + " ".join(f"{value:.6f}" for value in (*origin, *turn)))
    Path("walk.txt").write_text("\n".join(lines) + "\n")


def photo(size: tuple[int, int]) -> None:
    """Four centimetres and a degree away from the scene's own camera, which is where a search starts."""
    start = np.array(room().sensors()[0].world_transform().matrix, dtype=np.float64).reshape(4, 4)
    pose = start @ mitsuba_crb.se3.exp([0.03, 0.0, 0.03, 0.0, 0.017, 0.0])
    noise = np.random.default_rng(0).normal(0.0, 2.0, (size[1], size[0], 3))
    codes = 255 * displayed(rendered(pose, size)) + noise
    Image.fromarray(np.uint8(np.clip(np.round(codes), 0, 255))).save("photo.png")


def capture(size: tuple[int, int]) -> None:
    """Thirty-two photographs from a walk before the sofa."""
    folder = Path("capture")
    (folder / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for k, pose in enumerate(views(VIEWS)):
        name = f"images/{k:03d}.png"
        Image.fromarray(np.uint8(np.round(255 * displayed(rendered(pose, size))))).save(folder / name)
        frames.append({"file_path": name, "transform_matrix": (pose @ OPENGL).tolist()})
    focal = focal_length(size)
    intrinsics = {
        "w": size[0],
        "h": size[1],
        "fl_x": focal,
        "fl_y": focal,
        "cx": size[0] / 2,
        "cy": size[1] / 2,
    }
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}, indent=1))


def splats(size: tuple[int, int]) -> None:
    """A round splat where the ray through each pixel of three views ends, as large as the pixel."""
    folder = Path("splats")
    folder.mkdir(exist_ok=True)
    seen = [points(pose, size) for pose in views(3)]
    means, spacing, colours = (np.concatenate(part) for part in zip(*seen, strict=True))
    count = len(means)
    columns = {
        **{axis: means[:, k] for k, axis in enumerate("xyz")},
        **{f"f_dc_{k}": (colours[:, k] - 0.5) / 0.28209479 for k in range(3)},  # of spherical harmonics
        "opacity": np.full(count, 2.2),  # its logit
        **{f"scale_{k}": np.log(0.6 * spacing) for k in range(3)},
        **{f"rot_{k}": np.full(count, float(k == 0)) for k in range(4)},
    }
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [*(f"property float {name}" for name in columns), "end_header", ""]
    rows = np.stack(list(columns.values()), axis=1).astype("<f4")
    (folder / "room.ply").write_bytes("\n".join(header).encode() + rows.tobytes())
    focal = focal_length(size)
    cameras = [
        {
            "id": k,
            "img_name": f"view{k}",
            "width": size[0],
            "height": size[1],
            "fx": focal,
            "fy": focal,
            "position": pose[:3, 3].tolist(),
            "rotation": (pose @ OPENCV)[:3, :3].tolist(),
        }
        for k, pose in enumerate(views(3))
    ]
    (folder / "cameras.json").write_text(json.dumps(cameras, indent=1))


def views(count: int) -> list[np.ndarray]:
    """Poses beside one another, all of which look at the sofa."""
    angles = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    return [
        looking(
            np.array([1.2 * np.cos(a), -0.3 + 0.5 * np.sin(a), 1.45 + 0.25 * np.sin(2 * a)]),
            np.array([-0.2 + 0.5 * np.sin(a), 3.6, 0.9 + 0.15 * np.cos(3 * a)]),
        )
        for a in angles
    ]


def focal_length(size: tuple[int, int]) -> float:
    """In pixels."""
    return float(size[0] / 2 / np.tan(np.radians(FOV) / 2))


@functools.cache
def room() -> mi.Scene:
    """The shipped sitting room."""
    return mitsuba_crb.load_scene(ROOM)


@functools.cache
def camera(size: tuple[int, int]) -> mi.Sensor:
    """Like the room's, of another size."""
    return mi.load_dict(
        {
            "type": "perspective",
            "id": "camera",
            "fov": FOV,
            "near_clip": 0.01,
            "far_clip": 100.0,
            "film": {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "gaussian"}},
        }
    )


def viewed(pose: np.ndarray, size: tuple[int, int]) -> mi.Sensor:
    """The camera moved there; a new one would be compiled anew."""
    parameters = mi.traverse(camera(size))
    parameters["to_world"] = mi.Transform4f(pose.astype(np.float32))
    parameters.update()
    return camera(size)


def rendered(pose: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Linear radiance, rows by columns by channels."""
    return np.array(mi.render(room(), sensor=viewed(pose, size), spp=PATHS, seed=0))[..., :3]


def displayed(radiance: np.ndarray) -> np.ndarray:
    """Radiance as sRGB from 0 to 1."""
    light = np.clip(radiance / WHITE, 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def points(pose: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the rays through the pixels' centres end, the pixels' size there, and their colours."""
    sensor, scene = viewed(pose, size), room()
    u, v = np.meshgrid((np.arange(size[0]) + 0.5) / size[0], (np.arange(size[1]) + 0.5) / size[1])
    film = mi.Point2f(mi.Float(u.ravel().astype(np.float32)), mi.Float(v.ravel().astype(np.float32)))
    ray, _ = sensor.sample_ray(0.0, 0.5, film, 0.5)
    hit = scene.ray_intersect_preliminary(ray)
    distance = np.array(hit.t, dtype=np.float64)
    ends = np.array(ray(hit.t)).T.astype(np.float64)
    colours = displayed(rendered(pose, size)).reshape(-1, 3)
    seen = np.isfinite(distance)
    return ends[seen], distance[seen] / focal_length(size), colours[seen]


MAKERS = {
    "calibration": (calibration, "640x480"),
    "trajectory": (trajectory, "640x480"),
    "photo": (photo, "64x48"),
    "capture": (capture, "96x72"),
    "splats": (splats, "160x120"),
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Files to try the how-tos with.")
    parser.add_argument("what", choices=MAKERS)
    parser.add_argument("--size", metavar="WxH", help="of the images")
    asked = parser.parse_args()
    maker, usual = MAKERS[asked.what]
    width, height = (int(side) for side in (asked.size or usual).split("x"))
    mi.set_variant("llvm_ad_rgb")
    maker((width, height))

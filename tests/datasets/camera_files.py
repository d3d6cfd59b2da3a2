"""One camera in the words of other tools, with 17 digits."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from mitsuba_crb import Intrinsics
from mitsuba_crb.camera import LENS_MODELS

PLAIN = ("k1", "k2", "p1", "p2", "k3")
OPENCV = Intrinsics(
    size=(752, 480),
    focal=(458.65412345678901, 457.29612345678902),
    centre=(367.71512345678903, 248.87512345678904),
    model="opencv",
    distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0, 0.0, 0.0, 0.0),
)
"""The left camera of EuRoC, digits added."""
FISHEYE = Intrinsics(OPENCV.size, OPENCV.focal, OPENCV.centre, "fisheye", (-0.013, 0.021, -0.0062, 1.5e-3))
PINHOLE = Intrinsics(OPENCV.size, OPENCV.focal, OPENCV.centre)


def from_first_pixel(camera: Intrinsics) -> tuple[float, float]:
    """The principal point as OpenCV counts it."""
    return camera.centre[0] - 0.5, camera.centre[1] - 0.5


def colmap_line(camera: Intrinsics) -> str:
    """A row of `cameras.txt`."""
    model, count = {"pinhole": ("PINHOLE", 0), "opencv": ("OPENCV", 4), "fisheye": ("OPENCV_FISHEYE", 4)}[
        camera.model
    ]
    values = [*camera.focal, *camera.centre, *camera.distortion[:count]]
    return f"1 {model} {camera.size[0]} {camera.size[1]} {' '.join(f'{value:.17g}' for value in values)}"


def colmap_text(camera: Intrinsics) -> str:
    """`cameras.txt`."""
    return (
        f"# Camera list with one line of data per camera:\n# CAMERA_ID, MODEL, ...\n{colmap_line(camera)}\n"
    )


def colmap_binary(camera: Intrinsics) -> bytes:
    """`cameras.bin`."""
    model, count = {"pinhole": (1, 0), "opencv": (4, 4), "fisheye": (5, 4)}[camera.model]
    values = [*camera.focal, *camera.centre, *camera.distortion[:count]]
    return struct.pack(f"<QIiQQ{len(values)}d", 1, 1, model, *camera.size, *values)


def transforms(camera: Intrinsics) -> str:
    """`transforms.json`."""
    document = {
        "camera_model": {"pinhole": "PINHOLE", "opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE"}[camera.model],
        "fl_x": camera.focal[0],
        "fl_y": camera.focal[1],
        "cx": camera.centre[0],
        "cy": camera.centre[1],
        "w": camera.size[0],
        "h": camera.size[1],
        "frames": [],
    }
    names = {"pinhole": (), "opencv": PLAIN[:4], "fisheye": ("k1", "k2", "k3", "k4")}[camera.model]
    document.update(zip(names, camera.distortion, strict=False))
    return json.dumps(document)


def opencv_yaml(camera: Intrinsics) -> str:
    """What `cv::FileStorage` writes."""
    (fx, fy), (cx, cy) = camera.focal, from_first_pixel(camera)
    count = {"pinhole": 0, "opencv": 5, "fisheye": 4}[camera.model]
    coefficients = ", ".join(f"{value:.16e}" for value in camera.distortion[:count])
    distortion = f"""distortion_coefficients: !!opencv-matrix
   rows: {count}
   cols: 1
   dt: d
   data: [ {coefficients} ]
"""
    return f"""%YAML:1.0
---
calibration_time: "Mon 30 Nov 2026 03:14:23 PM UTC"
image_width: {camera.size[0]}
image_height: {camera.size[1]}
flags: 0
fisheye_model: {int(camera.model == "fisheye")}
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {fx:.16e}, 0., {cx:.16e}, 0., {fy:.16e}, {cy:.16e}, 0., 0., 1. ]
{distortion if count else ""}avg_reprojection_error: 1.9e-01
"""


def opencv_xml(camera: Intrinsics) -> str:
    """The same as XML."""
    (fx, fy), (cx, cy) = camera.focal, from_first_pixel(camera)
    coefficients = " ".join(f"{value:.16e}" for value in camera.distortion[:5])
    distortion = f"""<distortion_coefficients type_id="opencv-matrix">
  <rows>5</rows>
  <cols>1</cols>
  <dt>d</dt>
  <data>
    {coefficients}</data></distortion_coefficients>"""
    return f"""<?xml version="1.0"?>
<opencv_storage>
<image_width>{camera.size[0]}</image_width>
<image_height>{camera.size[1]}</image_height>
<fisheye_model>{int(camera.model == "fisheye")}</fisheye_model>
<camera_matrix type_id="opencv-matrix">
  <rows>3</rows>
  <cols>3</cols>
  <dt>d</dt>
  <data>
    {fx:.16e} 0. {cx:.16e} 0. {fy:.16e}
    {cy:.16e} 0. 0. 1.</data></camera_matrix>
{distortion if camera.distortion else ""}
</opencv_storage>
"""


def ros(camera: Intrinsics) -> str:
    """What `camera_calibration` writes."""
    (fx, fy), (cx, cy) = camera.focal, from_first_pixel(camera)
    model, count = {"pinhole": ("plumb_bob", 0), "opencv": ("plumb_bob", 5), "fisheye": ("equidistant", 4)}[
        camera.model
    ]
    coefficients = ", ".join(f"{value:.17g}" for value in camera.distortion[:count])
    return f"""image_width: {camera.size[0]}
image_height: {camera.size[1]}
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [{fx:.17g}, 0, {cx:.17g}, 0, {fy:.17g}, {cy:.17g}, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: [{coefficients}]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [{fx:.17g}, 0, {cx:.17g}, 0, 0, {fy:.17g}, {cy:.17g}, 0, 0, 0, 1, 0]
"""


def kalibr(camera: Intrinsics, name: str = "cam0") -> str:
    """A camera of Kalibr's chain."""
    (fx, fy), (cx, cy) = camera.focal, from_first_pixel(camera)
    model = {"pinhole": "none", "opencv": "radtan", "fisheye": "equidistant"}[camera.model]
    coefficients = ", ".join(f"{value:.17g}" for value in camera.distortion[:4])
    return f"""{name}:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [{coefficients}]
  distortion_model: {model}
  intrinsics: [{fx:.17g}, {fy:.17g}, {cx:.17g}, {cy:.17g}]
  resolution: [{camera.size[0]}, {camera.size[1]}]
  rostopic: /{name}/image_raw
"""


def euroc(camera: Intrinsics) -> str:
    """EuRoC's `sensor.yaml`."""
    (fx, fy), (cx, cy) = camera.focal, from_first_pixel(camera)
    model = {"pinhole": "none", "opencv": "radial-tangential", "fisheye": "equidistant"}[camera.model]
    coefficients = ", ".join(f"{value:.17g}" for value in camera.distortion[:4])
    return f"""sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
rate_hz: 20
resolution: [{camera.size[0]}, {camera.size[1]}]
camera_model: pinhole
intrinsics: [{fx:.17g}, {fy:.17g}, {cx:.17g}, {cy:.17g}] #fu, fv, cu, cv
distortion_model: {model}
distortion_coefficients: [{coefficients}]
"""


def own(camera: Intrinsics) -> str:
    """Our TOML."""
    names = {"pinhole": (), "opencv": PLAIN, "fisheye": ("k1", "k2", "k3", "k4")}[camera.model]
    lines = [f"{name} = {value!r}" for name, value in zip(names, camera.distortion, strict=False)]
    head = [
        f"size = {list(camera.size)}",
        f"focal = {list(camera.focal)}",
        f"centre = {list(camera.centre)}",
        f'model = "{camera.model}"',
    ]
    return "\n".join([*head, *lines, ""])


TEXTS = {
    "colmap": colmap_text,
    "transforms": transforms,
    "opencv_yaml": opencv_yaml,
    "opencv_xml": opencv_xml,
    "ros": ros,
    "kalibr": kalibr,
    "euroc": euroc,
    "own": own,
}
"""By format."""


def written(folder: Path, text: str | bytes, name: str = "file") -> Path:
    """A file with this in it, whose ending says nothing."""
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def distorted(camera: Intrinsics, points: np.ndarray) -> np.ndarray:
    """Where `Intrinsics` says that points at depth one land, axes x right, y down."""
    k = dict(zip(LENS_MODELS[camera.model], camera.distortion, strict=True))
    x, y = points.T
    r2 = x * x + y * y
    if camera.model == "fisheye":
        r = np.sqrt(r2)
        t = np.arctan(r)
        t2 = t * t
        scale = t * (1 + t2 * (k["k1"] + t2 * (k["k2"] + t2 * (k["k3"] + t2 * k["k4"])))) / r
        d = np.stack([x * scale, y * scale], axis=1)
    elif camera.model == "opencv":
        scale = (1 + r2 * (k["k1"] + r2 * (k["k2"] + r2 * k["k3"]))) / (
            1 + r2 * (k["k4"] + r2 * (k["k5"] + r2 * k["k6"]))
        )
        dx = 2 * k["p1"] * x * y + k["p2"] * (r2 + 2 * x * x)
        dy = k["p1"] * (r2 + 2 * y * y) + 2 * k["p2"] * x * y
        d = np.stack([x * scale + dx, y * scale + dy], axis=1)
    else:
        d = points
    return np.array(camera.centre) + np.array(camera.focal) * d

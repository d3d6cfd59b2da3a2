"""The cameras that lie beside a field's file, and their photographs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsuba_crb.errors import CameraError
from mitsuba_crb.radiance.beside import beside

FRAME = np.diag([1.0, -1.0, -1.0, 1.0])


def inria(folder: Path) -> None:
    entries = [
        {
            "id": k,
            "img_name": f"im{k}.png",
            "width": 32,
            "height": 24,
            "fx": 30.0,
            "fy": 31.0,
            "position": [float(k), 0.0, 0.0],
            "rotation": np.eye(3).tolist(),
        }
        for k in range(3)
    ]
    (folder / "cameras.json").write_text(json.dumps(entries))


def transforms(folder: Path) -> None:
    frames = [{"file_path": f"images/im{k}.png", "transform_matrix": FRAME.tolist()} for k in range(2)]
    document = {"w": 32, "h": 24, "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))


def colmap(folder: Path) -> None:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 32 24 30 30 16 12\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 0 1 im0.png\n\n")


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """INRIA's layout, three folders deep."""
    folder = tmp_path / "out" / "point_cloud" / "iteration_30000"
    folder.mkdir(parents=True)
    (folder / "point_cloud.ply").touch()
    return folder / "point_cloud.ply"


def test_nothing_beside_a_file_is_none(model: Path, tmp_path: Path) -> None:
    assert beside(model) is None
    assert beside(tmp_path / "missing.ply") is None
    assert beside(Path("splats")) is None


def test_inrias_lie_in_the_models_folder_or_beside(model: Path) -> None:
    root = model.parents[2]
    inria(root)
    (root / "images").mkdir()
    Image.new("RGB", (32, 24)).save(root / "images" / "im1.png")
    found = beside(model)
    assert found is not None
    assert found.source == root / "cameras.json"
    assert [viewpoint.name for viewpoint in found.viewpoints] == ["im0.png", "im1.png", "im2.png"]
    assert found.photographs == (None, root / "images" / "im1.png", None)
    assert found.viewpoints[2].pose[:3, 3].tolist() == [2.0, 0.0, 0.0]
    assert found.viewpoints[0].intrinsics.focal == (30.0, 31.0)
    # Looking along its own z, x left, y up.
    np.testing.assert_allclose(found.viewpoints[0].pose[:3, :3], np.diag([-1.0, -1.0, 1.0]))


@pytest.mark.parametrize(("write", "count"), [(inria, 3), (transforms, 2), (colmap, 1)])
def test_what_lies_beside_comes_first(model: Path, write, count: int) -> None:
    inria(model.parents[2])
    write(model.parent)
    found = beside(model)
    assert found is not None
    assert len(found.viewpoints) == len(found.photographs) == count
    assert found.viewpoints[0].intrinsics.size == (32, 24)


def test_poses_of_the_trained_models_world(model: Path) -> None:
    transforms(model.parent)
    transform = [[0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3]]
    (model.parent / "dataparser_transforms.json").write_text(
        json.dumps({"transform": transform, "scale": 0.5})
    )
    found = beside(model)
    assert found is not None
    assert found.viewpoints[0].pose[:3, 3].tolist() == [0.5, 1.0, 1.5]


def test_poses_without_cameras_say_what_is_missing(model: Path) -> None:
    frames = [{"file_path": "im.png", "transform_matrix": FRAME.tolist()}]
    (model.parent / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(CameraError, match="--camera FILE"):
        beside(model)

"""Writes every texture and mesh file of the scenes next to their XML: ``make_textures.py [FOLDER]``.

Deterministic: random numbers come from PCG64 with fixed seeds. Arrays of uint8 become PNG files and hold sRGB
colour; arrays of float16 become OpenEXR files and hold linear values, for patterns whose derivative matters
(8-bit steps would add information that the pattern does not have).
"""

from __future__ import annotations

import sys
from pathlib import Path

import meshes
import numpy as np
import OpenEXR
import patterns
import room_patterns
from PIL import Image

SCENES = Path(__file__).parent


def textures() -> dict[str, patterns.Array]:
    """Path below the scenes folder -> (height, width, 3): uint8 is sRGB (PNG), float16 linear (OpenEXR)."""
    return {
        "textured_wall/paint.exr": patterns.textured_wall(),
        "striped_wall/stripes.exr": patterns.striped_wall(),
        "radial_wall/rings.exr": patterns.radial_wall(),
        "sky/sky.exr": patterns.sky(),
        "warehouse/cartons.exr": patterns.cartons(),
        "warehouse/shutter.exr": patterns.shutter(),
        "warehouse/lanes.exr": patterns.lanes(),
        "warehouse/rings.exr": patterns.rings(),
        "textured_room/floor_boards.png": room_patterns.floor_boards(),
        "textured_room/walnut.png": room_patterns.walnut(),
        "textured_room/bricks.png": room_patterns.bricks(),
        "textured_room/plaster.png": room_patterns.plaster(),
        "textured_room/linen.png": room_patterns.linen(),
        "textured_room/ikat.png": room_patterns.ikat(),
        "textured_room/rug.png": room_patterns.rug(),
        "textured_room/picture.png": room_patterns.picture(),
        "textured_room/books.png": room_patterns.books(),
        "textured_room/leaf.png": room_patterns.leaf(),
    }


def mesh_files() -> dict[str, meshes.Mesh]:
    """Path below the scenes folder -> mesh."""
    return {
        "boxes/shared_box.ply": meshes.cube(shared=True),
        "boxes/split_box.ply": meshes.cube(shared=False),
        "shadows/frond.ply": meshes.frond(),
        "textured_room/sofa.ply": meshes.sofa(),
        "textured_room/cushions.ply": meshes.cushions(),
        "textured_room/table.ply": meshes.table(),
        "textured_room/book_case.ply": meshes.book_case(),
        "textured_room/books.ply": meshes.books(),
        "textured_room/picture_frame.ply": meshes.picture_frame(),
        "textured_room/skirting.ply": meshes.skirting(),
        "textured_room/pot.ply": meshes.pot(),
        "textured_room/palm.ply": meshes.palm(),
    }


def write(folder: Path) -> list[Path]:
    """Write all files below the folder and return their paths."""
    paths = []
    for name, pixels in textures().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if pixels.dtype == np.uint8:
            Image.fromarray(pixels).save(path, optimize=True)
        else:
            header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(header, {"RGB": pixels}) as file:
                file.write(str(path))
        paths.append(path)
    for name, mesh in mesh_files().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(mesh.ply())
        paths.append(path)
    return paths


if __name__ == "__main__":
    for written in write(Path(sys.argv[1]) if len(sys.argv) > 1 else SCENES):
        print(f"{written}  {written.stat().st_size / 1024:.0f} kB")

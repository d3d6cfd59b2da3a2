"""`boxes` with a faint, smooth texture on its wall: `forward` has rank 6, and is blind to the silhouettes.

The texture is bilinear, its contrast a tenth of weathered paint's, a texel a pixel of a picture 79 wide.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from mitsuba_crb.render.backend import use_mitsuba

if TYPE_CHECKING:
    import mitsuba as mi

SCENES = Path(__file__).parents[1] / "scenes"
CONTRAST = 0.1

_PAINT = f"""
<bsdf type="diffuse">
    <texture type="bitmap" name="reflectance">
        <string name="filename" value="{SCENES / "textured_wall" / "paint.exr"}"/>
        <boolean name="raw" value="true"/>
        <transform name="to_uv"><scale x="2" y="2"/></transform>
    </texture>
</bsdf>
"""


def faint_boxes(*, solids: bool = True) -> mi.Scene:
    """The shipped scene with that wall; without the solids, nothing in it is discontinuous."""
    use_mitsuba()
    import mitsuba as mi

    scene = ElementTree.parse(SCENES / "boxes" / "boxes.xml").getroot()
    for shape in scene.findall("shape"):
        if shape.get("id") == "wall":
            plain = shape.find("bsdf")
            blend = ElementTree.SubElement(shape, "bsdf", type="blendbsdf")
            ElementTree.SubElement(blend, "float", name="weight", value=str(CONTRAST))
            shape.remove(plain)
            blend.extend([plain, ElementTree.fromstring(_PAINT)])
        elif not solids:
            scene.remove(shape)
    # A string has no folder that file names could be relative to.
    for name in scene.iterfind("shape/string[@name='filename']"):
        name.set("value", str(SCENES / "boxes" / name.get("value")))
    return mi.load_string(ElementTree.tostring(scene, encoding="unicode"))

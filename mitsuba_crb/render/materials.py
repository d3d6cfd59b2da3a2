"""Materials of files of triangles as Mitsuba's: `principled` or `diffuse`, seen from both sides.

Images are decoded from sRGB by Mitsuba, or here where a factor multiplies them. Source: glTF 2.0, 3.9.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..datasets.scans import linear
from ..datasets.textured_mesh import Material, Texture, TexturedMesh
from .baked import baked

if TYPE_CHECKING:
    import mitsuba as mi

ATTRIBUTE = "{}_color"
"""Name of a mesh's colours, of its vertices or faces."""
_WHITE = (1.0, 1.0, 1.0)


class Materials:
    """What is made of materials, once for all meshes that share one."""

    def __init__(self, *, unlit: bool) -> None:
        """Make all of them shine by themselves, or only those that say so."""
        self.unlit = unlit
        self._made: dict[Any, Any] = {}

    def shines(self, mesh: TexturedMesh) -> bool:
        """Whether a mesh's colour is its radiance."""
        return self.unlit or mesh.material.unlit

    def properties(self, mesh: TexturedMesh) -> mi.Properties:
        """What a mesh is made of: its material, and its emitter if it has one."""
        import mitsuba as mi

        material, props = mesh.material, mi.Properties()
        if self.shines(mesh):
            # An emitter belongs to one shape.
            props["emitter"] = baked(mi.load_dict(self._colour(mesh)))
            props["bsdf"] = self._once("black", {"type": "diffuse", "reflectance": _constant((0.0,) * 3)})
            return props
        textured = mesh.uv is not None
        key = (material, textured, mesh.colours is not None and mesh.colours_of)
        props["bsdf"] = self._once(key, self._surface(mesh) if key not in self._made else {})
        if any(material.emission):
            shown = material.emission_texture if textured else None
            radiance = _image(shown, material.emission) if shown else _constant(material.emission)
            props["emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
        return props

    def _once(self, key: Any, description: dict[str, Any]) -> Any:
        import mitsuba as mi

        if key not in self._made:
            self._made[key] = mi.load_dict(description)
        return self._made[key]

    def _surface(self, mesh: TexturedMesh) -> dict[str, Any]:
        material, textured = mesh.material, mesh.uv is not None
        colour = self._colour(mesh)
        surface: dict[str, Any] = {"type": "diffuse", "reflectance": colour}
        if not material.diffuse:
            surface = {"type": "principled", "base_color": colour}
            for name, value, channel in (
                ("roughness", material.roughness, 1),
                ("metallic", material.metallic, 2),
            ):
                image = material.metallic_roughness
                surface[name] = _channel(image, channel, value) if textured and image else value
        if textured and material.normal is not None:
            surface = {
                "type": "normalmap",
                "normalmap": _normals(material.normal, material.normal_scale),
                "surface": surface,
            }
        surface = {"type": "twosided", "surface": surface}
        if material.transparency != "OPAQUE":
            opacity = self._opacity(material, textured)
            if opacity is not None:
                surface = {"type": "mask", "opacity": opacity, "surface": surface}
        return surface

    def _colour(self, mesh: TexturedMesh) -> dict[str, Any]:
        material = mesh.material
        if mesh.colours is not None:  # which hold the material's factor
            return {"type": "mesh_attribute", "name": ATTRIBUTE.format(mesh.colours_of)}
        if material.texture is not None and mesh.uv is not None:
            return _image(material.texture, material.colour)
        return _constant(material.colour)

    def _opacity(self, material: Material, textured: bool) -> Any:
        """A number, a texture, or None for 1 everywhere."""
        texture = material.texture
        if not textured or texture is None or texture.pixels.shape[2] < 4:
            alpha: Any = np.float32(material.opacity)
        else:
            alpha = texture.pixels[..., 3:].astype(np.float32) / 255.0 * material.opacity
        if material.transparency == "MASK":
            alpha = np.where(alpha >= material.cutoff, np.float32(1.0), np.float32(0.0))
        if np.min(alpha) >= 1.0:
            return None
        return _bitmap(alpha, texture, raw=True) if texture is not None and np.ndim(alpha) else float(alpha)


def _constant(colour: tuple[float, float, float]) -> dict[str, Any]:
    return {"type": "rgb", "value": list(colour)}


def _image(texture: Texture, factor: tuple[float, float, float]) -> dict[str, Any]:
    pixels = texture.pixels[..., :3]
    if factor == _WHITE:
        return _bitmap(pixels, texture, raw=False)
    return _bitmap((linear(pixels) * factor).astype(np.float32), texture, raw=True)


def _channel(texture: Texture, channel: int, factor: float) -> dict[str, Any]:
    return _bitmap(
        texture.pixels[..., channel, None].astype(np.float32) * (factor / 255.0), texture, raw=True
    )


def _normals(texture: Texture, scale: float) -> dict[str, Any]:
    pixels = texture.pixels[..., :3]
    if scale == 1.0:
        return _bitmap(pixels, texture, raw=True)
    normal = pixels.astype(np.float32) / 255.0 * 2.0 - 1.0
    normal[..., :2] *= scale
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-6)
    return _bitmap(0.5 + 0.5 * normal, texture, raw=True)


def _bitmap(pixels: Any, texture: Texture, *, raw: bool) -> dict[str, Any]:
    import mitsuba as mi

    (across, down), (left, above) = texture.scale, texture.offset
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.array(pixels, order="C")),
        "raw": raw,
        "format": "auto",  # bytes stay bytes, a quarter of the memory
        "wrap_mode": texture.wrap,
        "filter_type": "nearest" if texture.nearest else "bilinear",
        "to_uv": mi.ScalarTransform4f().translate([left, above, 0.0]).scale([across, down, 1.0]),
    }

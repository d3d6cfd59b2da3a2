"""The gallery's scenes: every plugin of Mitsuba alone in a small picture, as XML files that are written here.

Most stand before a textured wall under a point light and are seen after two bounces, which leaves no noise
but the film's; what shows by reflection or transmission alone stands between two textured lamps. Files name
their filter, width and height as `<default>`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

SIZE = (24, 18)
"""Width and height [pixel]."""

_SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
_SPECTRA = ("d65", "srgb", "regular", "irregular", "uniform", "rawconstant", "blackbody")
NOT_COVERED = {
    **dict.fromkeys(_SAMPLERS, "samplers; random numbers are mitsuba_crb's own"),
    **dict.fromkeys(_SPECTRA, "spectra; three numbers under an rgb variant"),
    "measured": "needs a file of measurements by others",
    "measured_polarized": "needs a file of measurements by others, and a polarised variant",
    "blender": "a mesh in Blender's memory",
}
"""Plugins that have no scene, and why."""

DOCUMENT = """<scene version="3.0.0">
<default name="filter" value="gaussian"/>
<default name="width" value="{width}"/>
<default name="height" value="{height}"/>
{integrator}
{sensor}
{rest}
</scene>
"""


@dataclass(frozen=True)
class Picture:
    """One scene's text."""

    kind: str
    name: str
    """The plugin's, perhaps with a word on how it is used."""
    text: str
    own_filter: bool = False
    """Whether its film has the one filter that it is about."""

    @property
    def plugins(self) -> set[str]:
        """Types of everything in it."""
        return set(re.findall(r'<(?!default)\w+ [^>]*?type="(\w+)"', self.text))

    def write(self, folder: Path) -> Path:
        """Its file, beside those that it names."""
        path = folder / f"{self.kind}_{re.sub(r'[^a-z0-9]+', '_', self.name)}.xml"
        path.write_text(self.text)
        return path


# What scenes are made of


def node(tag: str, kind: str, inside: str = "", name: str = "") -> str:
    """An element of some plugin."""
    return f'<{tag} type="{kind}"{f" name={name!r}" if name else ""}>{inside}</{tag}>'.replace("'", '"')


def values(tag: str, **named: object) -> str:
    """Elements with a value."""
    return "".join(f'<{tag} name="{name}" value="{value}"/>' for name, value in named.items())


def floats(**named: float) -> str:
    return values("float", **named)


def rgb(name: str, value: object) -> str:
    return values("rgb", **{name: value})


def file(name: str) -> str:
    return values("string", filename=name)


def place(*steps: str) -> str:
    """The transformation of a shape or a light."""
    return f'<transform name="to_world">{"".join(steps)}</transform>'


def move(x: float, y: float, z: float) -> str:
    return f'<translate x="{x}" y="{y}" z="{z}"/>'


def scale(x: float, y: float | None = None, z: float | None = None) -> str:
    return f'<scale x="{x}" y="{x if y is None else y}" z="{x if z is None else z}"/>'


def turn(x: float, y: float, z: float, angle: float) -> str:
    return f'<rotate x="{x}" y="{y}" z="{z}" angle="{angle}"/>'


def look(origin: str, target: str) -> str:
    return place(f'<lookat origin="{origin}" target="{target}" up="0, 1, 0"/>')


def bitmap(name: str, what: str = "texture", sampling: str = "bilinear") -> str:
    """A texture from a file, its values as they are."""
    inside = file(f"{what}.exr") + values("boolean", raw="true") + values("string", filter_type=sampling)
    return node("texture", "bitmap", inside, name)


def bsdf(kind: str, inside: str = "") -> str:
    return node("bsdf", kind, inside)


def matt(reflectance: str) -> str:
    return bsdf("diffuse", reflectance)


GREY = matt(rgb("reflectance", 0.8))
PAINTED = matt(bitmap("reflectance"))
FACING = place(turn(0, 1, 0, 180), scale(6), move(0, 0, 3))
ROOM = move(0.1, 0.2, 2.0)
POINT = node("emitter", "point", '<point name="position" x="0.8" y="1.2" z="-1"/>' + rgb("intensity", 20))


def wall(surface: str = PAINTED) -> str:
    """A square that fills the view."""
    return node("shape", "rectangle", FACING + surface)


def shape(kind: str, inside: str = "", surface: str = GREY) -> str:
    return node("shape", kind, inside + surface)


def lamp(where: str, radiance: str, kind: str = "area") -> str:
    """A rectangle that shines and reflects nothing."""
    black = matt(rgb("reflectance", 0))
    return node("shape", "rectangle", where + black + node("emitter", kind, radiance))


def film(
    kind: str = "hdrfilm", inside: str = values("string", pixel_format="rgb"), by: str = "$filter"
) -> str:
    size = values("integer", width="$width", height="$height")
    return node("film", kind, size + inside + node("rfilter", by))


def camera(kind: str = "perspective", inside: str = "", of: str | None = None) -> str:
    fov = floats(fov=45) if kind in ("perspective", "thinlens") else ""
    return node("sensor", kind, fov + look("0, 0, 0", "0.1, 0.2, 3") + inside + (of or film()))


def integrator(kind: str = "path", depth: int = 2, inside: str = "") -> str:
    return node("integrator", kind, values("integer", max_depth=depth) + inside)


def picture(
    kind: str, name: str, *parts: str, traced: str = "", seen: str = "", own_filter: bool = False
) -> Picture:
    """A scene of some parts."""
    text = DOCUMENT.format(
        width=SIZE[0],
        height=SIZE[1],
        integrator=traced or integrator(),
        sensor=seen or camera(),
        rest="\n".join(parts),
    )
    return Picture(kind, name, text, own_filter)


# The scenes, kind by kind


def shapes() -> Iterable[Picture]:
    """Each before the textured wall."""

    def flat(kind: str) -> str:
        return file(f"cube.{kind}") + values("boolean", face_normals="true")

    tilted = place(scale(0.3), turn(1, 1, 0, 35), ROOM)
    mesh = {name: shape(name, flat(name) + tilted) for name in ("ply", "obj", "serialized")}
    field = place(move(-0.5, -0.5, -0.5), scale(1.2), turn(0, 1, 0, 20), ROOM)
    group = f'<shape type="shapegroup" id="group">{shape("cube", place(scale(0.3)))}</shape>'
    instance = node("shape", "instance", place(turn(1, 1, 0, 35), ROOM) + '<ref id="group"/>')
    two = place(scale(0.2), turn(1, 1, 0, 35), move(0.5, 0.2, 2.0))
    merged = node("shape", "merge", shape("ply", flat("ply") + tilted) + shape("ply", flat("ply") + two))
    points = '<point name="p0" x="-0.3" y="-0.2" z="2"/><point name="p1" x="0.4" y="0.5" z="2"/>'
    centre = '<point name="center" x="-0.1" y="0.15" z="2"/>'
    parts = {
        "sphere": shape("sphere", centre + floats(radius=0.45)),
        "cylinder": shape("cylinder", points + floats(radius=0.2)),
        "disk": shape("disk", place(scale(0.4), turn(1, 0, 0, 150), ROOM)),
        "rectangle": shape("rectangle", place(scale(0.4), turn(1, 0, 0, 150), ROOM)),
        "cube": shape("cube", tilted),
        **mesh,
        "bsplinecurve": shape("bsplinecurve", file("curve.txt")),
        "linearcurve": shape("linearcurve", file("curve.txt")),
        "sdfgrid": shape("sdfgrid", file("distance.vol") + field),
        "instance": group + instance,
        "merge": merged,
    }
    yield from (picture("shape", name, wall(), POINT, inside) for name, inside in parts.items())
    for name in ("ellipsoids", "ellipsoidsmesh"):
        cloud = node("shape", name, file("cloud.ply"))
        yield picture("shape", name, cloud, traced=integrator("volprim_rf_basic", 32))


def emitters() -> Iterable[Picture]:
    """Each lights the textured wall, or is what is seen."""
    beyond = place(turn(0, 1, 0, 180), scale(6), move(0, 0, 3))
    aimed = look("0.8, 1.2, -1", "0.1, 0.2, 3")
    ball = shape("sphere", '<point name="center" x="-0.1" y="0.15" z="2"/>' + floats(radius=0.45))
    ceiling = place(turn(1, 0, 0, 90), scale(0.4), move(0, 1.6, 1.5))
    sun = '<vector name="sun_direction" x="0.4" y="0.5" z="-1"/>'
    hours = floats(window_start_time=9, window_end_time=15, latitude=45, longitude=10, timezone=1)
    first = values("integer", start_year=2025, start_month=6, start_day=1)
    last = values("integer", end_year=2025, end_month=6, end_day=3)
    sky = place(turn(1, 0, 0, -120))
    yield picture("emitter", "area, seen", lamp(beyond, bitmap("radiance")))
    yield picture("emitter", "area, lights", wall(), lamp(ceiling, rgb("radiance", 8)))
    yield picture(
        "emitter", "directionalarea", wall(), lamp(place(scale(9)), rgb("radiance", 2), "directionalarea")
    )
    for name, inside in {
        "constant": rgb("radiance", 1),
        "directional": '<vector name="direction" x="0.3" y="-0.4" z="1"/>' + rgb("irradiance", 3),
        "point": '<point name="position" x="0.8" y="1.2" z="-1"/>' + rgb("intensity", 20),
        "spot": aimed + rgb("intensity", 20) + floats(cutoff_angle=14, beam_width=8),
        "projector": aimed + floats(fov=30, scale=8) + bitmap("irradiance", "smooth"),
        "sunsky": sun + floats(turbidity=3, sun_scale=0.05) + sky,
        "timed_sunsky": hours + first + last + floats(turbidity=3) + sky,
    }.items():
        yield picture("emitter", name, wall(), node("emitter", name, inside))
    yield picture("emitter", "envmap", ball, node("emitter", "envmap", file("sky.exr")))


def bsdfs() -> Iterable[Picture]:
    """On a plane under the point light, or between two lamps if light is seen by delta lobes alone."""
    ball = '<point name="center" x="-0.1" y="0.15" z="2"/>' + floats(radius=0.6)
    glossy = bsdf("roughconductor", floats(alpha=0.4))
    opacity = bitmap("opacity", "smooth")
    ends = '<point name="p0" x="0.7" y="-2" z="1.5"/><point name="p1" x="0.3" y="2" z="1.7"/>'
    pole = shape("cylinder", ends + floats(radius=0.3), bsdf("hair"))
    for name, inside in {
        "diffuse": bitmap("reflectance"),
        "roughconductor": floats(alpha=0.3),
        "plastic": bitmap("diffuse_reflectance"),
        "roughplastic": floats(alpha=0.2) + bitmap("diffuse_reflectance"),
        "principled": bitmap("base_color") + floats(roughness=0.3, metallic=0.3, specular=0.6),
        "principledthin": bitmap("base_color") + floats(roughness=0.3, spec_trans=0.2, diff_trans=0.5),
        "pplastic": floats(alpha=0.2) + bitmap("diffuse_reflectance"),
        "blendbsdf": bitmap("weight", "smooth") + glossy + GREY,
        "mask": opacity + PAINTED,
        "twosided": PAINTED,
        "bumpmap": bitmap("", "heights") + floats(scale=0.3) + PAINTED,
        "normalmap": bitmap("normalmap", "normals") + PAINTED,
    }.items():
        yield picture("bsdf", name, wall(bsdf(name, inside)), POINT)
    behind = lamp(place(scale(9), move(0, 0, -4)), bitmap("radiance", "smooth"))
    beyond = lamp(place(turn(0, 1, 0, 180), scale(9), move(0, 0, 5)), bitmap("radiance", "smooth"))
    for name, inside in {
        "conductor": "",
        "dielectric": "",
        "thindielectric": "",
        "roughdielectric": floats(alpha=0.3),
        "polarizer": "",
        "retarder": "",
        "circular": "",
    }.items():
        surface = bsdf(name, inside)
        yield picture("bsdf", name, wall(surface), behind, beyond, traced=integrator(depth=4))
    veil = node(
        "shape", "rectangle", place(turn(0, 1, 0, 180), scale(0.6), ROOM) + bsdf("mask", opacity + GREY)
    )
    yield picture("bsdf", "mask, before a wall", wall(), veil, POINT, traced=integrator(depth=4))
    yield picture(
        "bsdf", "null", wall(), shape("sphere", ball, bsdf("null")), POINT, traced=integrator(depth=4)
    )
    yield picture("bsdf", "hair", wall(), pole, POINT)


def textures() -> Iterable[Picture]:
    """Each on the wall, or on a mesh of its own."""
    repeated = '<transform name="to_uv"><scale x="12" y="12"/></transform>'
    grid = node("volume", "gridvolume", file("colours.vol") + place(scale(8), move(-4, -4, -1)), "volume")
    for name, inside in {
        "bitmap, bilinear": bitmap("reflectance"),
        "bitmap, nearest": bitmap("reflectance", sampling="nearest"),
        "checkerboard": node("texture", "checkerboard", repeated, "reflectance"),
        "volume": node("texture", "volume", grid, "reflectance"),
    }.items():
        yield picture("texture", name, wall(matt(inside)), POINT)
    attribute = node("texture", "mesh_attribute", values("string", name="vertex_color"), "reflectance")
    mesh = shape("ply", file("sheet.ply") + FACING, matt(attribute))
    yield picture("texture", "mesh_attribute", mesh, POINT)


def media() -> Iterable[Picture]:
    """Each fills a cube before the wall."""
    clear = bsdf("null")
    albedo = rgb("albedo", 0.8)

    def phase(kind: str, inside: str = "") -> str:
        return node("phase", kind, inside)

    def filled(kind: str, name: str, medium: str, inside: str, traced: str = "volpath") -> Picture:
        cube = place(scale(0.4), turn(1, 1, 0, 35), ROOM)
        volume = node("medium", medium, inside, "interior")
        return picture(
            kind, name, wall(), POINT, shape("cube", cube, clear + volume), traced=integrator(traced)
        )

    thick = floats(scale=2, sigma_t=1) + albedo
    density = node(
        "volume", "gridvolume", file("density.vol") + place(scale(2), move(-0.9, -0.8, 1)), "sigma_t"
    )
    white = node("volume", "constvolume", floats(value=0.8), "albedo")
    ellipsoid = node("volume", "gridvolume", file("sggx.vol"), "S")
    yield filled("medium", "homogeneous", "homogeneous", thick)
    yield filled("medium", "homogeneous, volpathmis", "homogeneous", thick, "volpathmis")
    yield filled("medium", "homogeneous, prbvolpath", "homogeneous", thick, "prbvolpath")
    yield filled("medium", "heterogeneous", "heterogeneous", floats(scale=4) + albedo + density)
    yield filled("volume", "constvolume", "heterogeneous", floats(scale=4) + white + density)
    for name, inside in {
        "isotropic": "",
        "hg": floats(g=0.6),
        "rayleigh": "",
        "tabphase": values("string", values="0.3, 0.5, 1.0, 2.0"),
        "blendphase": floats(weight=0.4) + phase("hg", floats(g=0.6)) + phase("isotropic"),
        "sggx": ellipsoid,
    }.items():
        yield filled("phase", name, "homogeneous", thick + phase(name, inside))


def cameras() -> Iterable[Picture]:
    """Films, filters and sensors before a ball and the wall."""
    ball = shape("sphere", '<point name="center" x="-0.1" y="0.15" z="2"/>' + floats(radius=0.45))
    for pixel_format in ("rgb", "rgba", "luminance", "luminance_alpha", "xyz"):
        of = film(inside=values("string", pixel_format=pixel_format))
        yield picture("film", f"hdrfilm, {pixel_format}", wall(), ball, POINT, seen=camera(of=of))
    bands = '<spectrum name="band" value="400:0, 500:1, 600:1, 700:0"/>'
    yield picture("film", "specfilm", wall(), ball, POINT, seen=camera(of=film("specfilm", bands)))
    for name in ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos"):
        seen = camera(of=film(by=name))
        yield picture("filter", name, wall(), ball, POINT, seen=seen, own_filter=True)
    inside = {"thinlens": floats(aperture_radius=0.1, focus_distance=2.5)}
    for name in ("perspective", "thinlens", "orthographic", "radiancemeter", "distant"):
        yield picture("sensor", name, wall(), ball, POINT, seen=camera(name, inside.get(name, "")))
    both = node("sensor", "batch", camera() + camera() + film())
    yield picture("sensor", "batch", wall(), ball, POINT, seen=both)
    meter = wall(PAINTED + node("sensor", "irradiancemeter", film()))
    yield picture("sensor", "irradiancemeter", meter, ball, POINT, seen=" ")


def integrators() -> Iterable[Picture]:
    """Each sees a ball and the wall under a point light, which `prb_basic` would not see."""
    ball = shape("sphere", '<point name="center" x="-0.1" y="0.15" z="2"/>' + floats(radius=0.45))
    depth = values("integer", max_depth=3)
    inner = integrator("path", 3)
    for name, inside in {
        "path": depth,
        "direct": "",
        "volpath": depth,
        "volpathmis": depth,
        "prb": depth,
        "prb_basic": depth,
        "prbvolpath": depth,
        "direct_projective": "",
        "prb_projective": depth,
        "aov": values("string", aovs="dd.y:depth") + inner,
        "moment": inner,
        "depth": "",
        "ptracer": depth,
        "stokes": inner,
    }.items():
        light = node("emitter", "constant", rgb("radiance", 1)) if name == "prb_basic" else POINT
        yield picture("integrator", name, wall(), ball, light, traced=node("integrator", name, inside))


def gallery() -> list[Picture]:
    """All scenes."""
    kinds = (shapes, emitters, bsdfs, textures, media, cameras, integrators)
    return [one for kind in kinds for one in kind()]


# The files that they name


def write(folder: Path) -> dict[Path, Picture]:
    """Write all scenes and their files into a folder."""
    from gallery_files import write_files

    write_files(folder)
    return {one.write(folder): one for one in gallery()}


def missing(plugins: Iterable[str]) -> set[str]:
    """Those of some plugins that neither stand in a scene nor have a reason not to."""
    return set(plugins) - set().union(*(one.plugins for one in gallery())) - set(NOT_COVERED)

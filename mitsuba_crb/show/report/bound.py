"""The report of `mitsuba-crb bound` at one pose."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...noise.measured import DISPLAY_REFERRED, RADIANCE
from ..bound_table import measured_facts, pixels_measured
from .ellipsoids import Ellipsoid
from .layers import picture_layers
from .markup import Markup, joined, tag
from .page import Origin, Page, section, side_by_side, write_page
from .space import space
from .tables import cells, deviations, facts, number, significant, table, verdict_mark
from .viewers import picture_viewer, space_viewer

if TYPE_CHECKING:
    from ...measure.outlook import Outlook
    from ...measure.pictures import Pictures


def write_bound_report(
    path: Path, document: Mapping[str, Any], pictures: Pictures | None, outlook: Outlook, origin: Origin
) -> None:
    """Write the page of a bound.

    Args:
        path: the file.
        document: from `bound_document`.
        pictures: of the same measurement; None of noise that couples pixels.
        outlook: the world and the camera.
        origin: the command.

    Raises:
        OutputError: plotly is not installed.
    """
    write_page(path, bound_page(document, pictures, outlook), origin)


def bound_page(document: Mapping[str, Any], pictures: Pictures | None, outlook: Outlook) -> Page:
    """The page of a bound; arguments as of `write_bound_report`."""
    width, height = document["size"]
    summary = [f"{width}×{height} pixels", f"rank {document['rank']} of 6", f"{document['method']}"]
    ellipsoid = Ellipsoid.of("camera", document["pose"], document["ellipsoids"]["position"])
    view = space(outlook, [ellipsoid])
    left = [section("Bound", deviations(document), verdict_words(document))]
    left += [section(*part) for part in _further(document)]
    basis = section("What it rests on", facts(_facts(document)))
    right = []
    data: dict[str, Any] = {"space": view, "images": {}}
    if pictures is not None:
        measures = document["measures"] or {}
        unit = measures.get("colour", measures).get("unit", RADIANCE)
        layers = picture_layers(pictures, unit=unit, displayed=unit == DISPLAY_REFERRED)
        data["images"]["view"] = layers
        right.append(section("Pictures", picture_viewer("view", layers, label="Image and derivatives")))
    long = len(left) > 1 or document["unobserved"]
    (right if long else left).append(basis)  # so that both columns are about as long
    sections = [side_by_side(left, right), section("In the world", space_viewer(view), kind="wide")]
    return Page(Path(str(document["scene"])).name, summary, sections, notices(document), data)


def notices(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What the method cannot see, and what was warned of."""
    blind = document.get("no_bound") or []
    others = [text for text in document.get("warnings") or [] if text not in blind]
    return [
        *(("bad", f"no bound: {text}") for text in blind),
        *(("note", text) for text in others),
    ]


def verdict_words(document: Mapping[str, Any]) -> Markup:
    """The directions that are not seen, in words, and how many paths decide those that are not resolved."""
    rows = []
    for direction in document["unobserved"]:
        factor = direction["paths_factor"]
        more = "" if factor is None else f"; about {factor} times the paths decide"
        rows.append(tag("li", verdict_mark(direction["verdict"]), f" {direction['description']}{more}"))
    if not rows:
        return tag("p", "All six directions are seen.", class_="muted")
    return tag("ul", *rows, class_="directions")


def _facts(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [("rank", f"{document['rank']} of 6")]
    if document["weakest"] is not None:
        rows.append(("weakest seen", document["weakest"]["description"]))
    eigenvalues = ", ".join(significant(number(value)) for value in document["eigenvalues"])
    rows.append(("eigenvalues", f"{eigenvalues} (camera frame, translation in length scales)"))
    scalars = document["optimality"]
    rows.append(
        (
            "optimality",
            f"D: ln det F = {significant(number(scalars['log_det']), 4)}, "
            f"A: tr F⁻¹ = {significant(number(scalars['trace_inverse']))}, "
            f"E: λ_min = {significant(number(scalars['smallest_eigenvalue']))}",
        )
    )
    rows.append(("length scale", f"{document['length_scale']:.4g} scene units"))
    rows.append(("matrices", f"in the {document['frame']} frame"))
    rows += measured_facts(document["measures"] or {})
    noise = document["noise"] or {}
    words = str(noise.get("description", "given"))
    if noise.get("sigma") is not None:
        words = f"Gaussian, σ = {noise['sigma']:.4g} {noise.get('unit', RADIANCE)}"
    origin = noise.get("origin")
    rows.append(("noise", f"{words} ({origin})" if origin else words))
    if document["prior"]:
        rows.append(("prior", f"{document['prior']}, included"))
    rows.append(("pixels", pixels_measured(document["pixels"])))
    rows.append(("paths", paths_words(document)))
    return rows


def paths_words(document: Mapping[str, Any]) -> str:
    """How many paths there were, and where they went."""
    if document.get("deterministic"):
        return "none: deterministic"
    sampling = document.get("sampling")
    if not sampling:
        return f"{document['spp']} per pixel in {document['batches']} batches, seed {document['seed']}"
    spp = sampling["spp"]
    paths = f"{spp['most']} per pixel"
    if spp["least"] < spp["most"]:
        paths = f"{spp['least']} to {paths} ({spp['mean']:.3g} on average)"
    return f"{paths} in {document['batches']} batches, seed {document['seed']}"


def _further(document: Mapping[str, Any]) -> list[tuple[Any, ...]]:
    """Bounds beside the bound: those with a nuisance known, over displacements, with the map's error."""
    heads = ("", "x", "y", "z", "pitch", "yaw", "roll")
    own = [*document["position_std"], *document["rotation_std_deg"]]
    rows = {"bound": own}
    known = document["nuisances"]["if_known"]
    rows |= {
        f"if {name} were known": [*each["position_std"], *each["rotation_std_deg"]]
        for name, each in known.items()
    }
    for key, words in (("hcr", "over finite displacements"), ("misspecified", "least squares with this map")):
        if key in document:
            rows[words] = [*document[key]["position_std"], *document[key]["rotation_std_deg"]]
    if len(rows) == 1:
        return []
    written = [
        cells([name, *(significant(number(value)) for value in values)]) for name, values in rows.items()
    ]
    caption = "Standard deviations: position [scene unit], rotation [deg]"
    return [("Beside the bound", joined(table(heads, written, caption=caption)))]

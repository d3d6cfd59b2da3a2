"""The report of `mitsuba-crb validate`: errors of an estimator beside the bound."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

from ... import se3
from ..bound_table import pixels_measured
from ..terminal import paths_said
from .bound import verdict_words
from .charts import calibration, ratios
from .ellipsoids import Ellipsoid
from .layers import render_layer
from .markup import Markup, tag
from .page import Origin, Page, section, side_by_side, write_page
from .space import space
from .tables import cells, deviations, facts, number, significant, table
from .viewers import chart_place, picture_viewer, space_viewer

if TYPE_CHECKING:
    from ...measure.outlook import Outlook


def write_validation_report(
    path: Path, document: Mapping[str, Any], outlook: Outlook, origin: Origin
) -> None:
    """Write the page of trials.

    Args:
        path: the file.
        document: from `validation_document`.
        outlook: the world and the camera.
        origin: the command.

    Raises:
        OutputError: plotly is not installed.
    """
    write_page(path, validation_page(document, outlook), origin)


def validation_page(document: Mapping[str, Any], outlook: Outlook) -> Page:
    """The page of trials; arguments as of `write_validation_report`."""
    settings, bound = document["settings"], document["bound"]
    width, height = settings["size"]
    pose = outlook.sights[0].pose
    failed = set(document["failed"])
    judged = document["results"][: document["trials"]]
    errors = np.array([trial["error"] for trial in judged if trial["index"] not in failed], dtype=np.float64)
    moved = se3.exp(errors)[:, :3, 3] @ pose[:3, :3].T
    F = np.array(bound["information"], dtype=np.float64)
    squares = np.einsum("ni,ij,nj->n", errors, F, errors)
    ellipsoid = Ellipsoid.of("camera", pose.tolist(), bound["ellipsoids"]["position"])
    view = space(outlook, [ellipsoid], scattered=moved)
    charts = {
        "calibration": calibration(stats.chi2.cdf(squares, 6).tolist(), document["coverage"]),
        "ratios": ratios(document["generalized_eigenvalues"], document["wishart_band"]),
    }
    sight = outlook.sights[0]
    layers = []
    if sight.image is not None:
        unit = "display value" if sight.displayed else "radiance"
        layers.append(
            render_layer(
                sight.image,
                name="Render",
                unit=unit,
                displayed=sight.displayed,
                about="what is aligned, in a few paths",
            )
        )
    kind = {"consistent": "good"}.get(document["verdict"], "bad")
    words = {
        "consistent": "The errors are as the bound says.",
        "inconsistent": "The errors are not as the bound says.",
        "inconclusive": "Inconclusive: the renderer's noise hides whether the errors are as the bound says; "
        + document["cure"]
        + ".",
    }[document["verdict"]]
    left = [
        section("Errors and bound", _errors(document), _consistency(document)),
        section("What it rests on", facts(_facts(document))),
    ]
    right = [
        section("Calibration", *(chart_place(key, each["alt"]) for key, each in charts.items())),
    ]
    below = [section("Bound", deviations(bound), verdict_words(bound))]
    beside = []
    if layers:
        beside.append(section("Pictures", picture_viewer("view", layers, label="Expected image")))
    sections = [
        side_by_side(left, right),
        section("In the world", space_viewer(view), kind="wide"),
        side_by_side(below, beside),
    ]
    summary = [
        f"{width}×{height} pixels",
        f"{document['trials']} trials, {len(failed)} failed",
        f"efficiency {document['efficiency']:.0%}",
    ]
    data = {"space": view, "charts": charts, "images": {"view": layers}}
    return Page(Path(settings["scene"]).name, summary, sections, [(kind, words)], data)


def _errors(document: Mapping[str, Any]) -> Markup:
    rows = [
        ("position, RMS", document["rmse_position"], document["bound_position"], "scene unit"),
        ("rotation, RMS", document["rmse_rotation_deg"], document["bound_rotation_deg"], "deg"),
    ]
    written = [
        cells([name, significant(number(found), 4), significant(number(bound), 4), unit])
        for name, found, bound, unit in rows
    ]
    return table(("", "errors", "bound", "unit"), written, caption="Errors of the estimates beside the bound")


def _consistency(document: Mapping[str, Any]) -> Markup:
    rows = [("NEES, mean", document["nees"], 6.0, document["nees_band"], document["nees"])]
    rows += [
        (f"variance ratio {k}", value, 1.0, band, value)
        for k, (value, band) in enumerate(
            zip(document["generalized_eigenvalues"], document["wishart_band"], strict=True), 1
        )
    ]
    rows += [
        (f"coverage at {c['nominal']:.0%}", c["empirical"], c["nominal"], (c["low"], c["high"]), c["nominal"])
        for c in document["coverage"]
    ]
    written = []
    for name, found, expected, (low, high), tested in rows:
        inside = low <= tested <= high
        mark = tag(
            "span", "inside" if inside else "outside", class_=f"verdict {'seen' if inside else 'unseen'}"
        )
        written.append(
            [*cells([name, f"{found:.3f}", f"{expected:g}", f"{low:.3f} to {high:.3f}"]), tag("td", mark)]
        )
    heads = ("", "found", "expected", "band", "")
    return table(
        heads, written, caption="What the errors say, with bands in which they are if the bound is met"
    )


def _facts(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    settings = document["settings"]
    return [
        ("noise", f"Gaussian, σ = {settings['sigma']:.4g}, of a camera that never saturates"),
        ("pixels", pixels_measured(settings["pixels"])),
        ("starts", f"within {settings['perturb_deg']:g} deg, {settings['perturb_trans']:g} scene units"),
        ("estimator", f"{settings['estimator']}, {paths_said(settings['spp'])}"),
        ("renderer's noise", f"adds {document['excess']:.1%} to the errors' covariance"),
        ("bound's own error", f"± {document['bound_uncertainty']:.1%}"),
    ]

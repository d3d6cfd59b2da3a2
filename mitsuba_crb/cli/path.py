"""`mitsuba-crb path`: the shortest path through a field of views that keeps the position known."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import Debug, JsonFile, PlanPlot, Report, Store
from .outcome import answered, foreseen
from .reports import check_report, report_path


def path(
    context: typer.Context,
    store: Store,
    start: Annotated[
        str, typer.Option("--from", metavar="N|X:Y:Z", help="Where to start: a place's number, or a point.")
    ],
    goal: Annotated[str, typer.Option("--to", metavar="N|X:Y:Z", help="Where to go, likewise.")],
    limit: Annotated[
        float,
        typer.Option(
            metavar="X", help="What the position bound, of all three axes together, may be (scene unit)."
        ),
    ],
    odometry: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml",
            help="What joins the views: translation_per_sqrt_length, rotation_deg_per_sqrt_length and "
            "rotation_deg_per_sqrt_turn; see `mitsuba_crb.planning.odometry`. Default: each view stands for "
            "itself.",
        ),
    ] = None,
    start_prior: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="With --odometry, what is known of the camera's pose at the start (.toml, .json); default: "
            "what a view there knows by itself.",
        ),
    ] = None,
    reach: Annotated[
        float | None,
        typer.Option(
            metavar="R",
            help="Places at most so far apart are next to each other (scene unit); default: those around "
            "each on a grid, else half again the median distance to the nearest.",
        ),
    ] = None,
    labels: Annotated[
        int | None,
        typer.Option(metavar="N", help="With --odometry, walks to keep at each place; default: 64."),
    ] = None,
    json_file: JsonFile = None,
    tum_file: Annotated[
        Path | None,
        typer.Option("--tum", metavar="FILE", help="Write the path as TUM's trajectory, a pose a second."),
    ] = None,
    plot_file: PlanPlot = None,
    report_file: Report = None,
    debug: Debug = False,
) -> int:
    """Which path keeps the position known well enough?

    The shortest one through a field of views whose position bound stays below a limit.

    Exit code 0 if there is one, 1 if there is none, 3 if the labels kept cannot tell.
    """
    with foreseen(debug):
        import numpy as np

        from ..bound.prior import load_prior
        from ..export.targets import check_targets
        from ..planning.label_search import LABELS
        from ..planning.odometry import load_odometry
        from ..planning.path_search import plan_path
        from ..planning.view_field import open_field

        inputs = [file for file in (odometry, start_prior) if file is not None]
        targets = {"--json": json_file, "--tum": tum_file, "--plot": plot_file, "--report": report_file}
        check_targets(targets, inputs)
        check_report(report_file)
        known = None if odometry is None else load_odometry(odometry)
        prior = None if start_prior is None else load_prior(start_prior)
        field = open_field(store)
        result = plan_path(
            field,
            start,
            goal,
            limit=limit,
            odometry=known,
            start_prior=prior,
            reach=reach,
            labels=LABELS if labels is None else labels,
        )

        from ..export.documents import write_json
        from ..export.plan_documents import path_document, write_path_as_tum
        from ..show.plan_table import print_path

        with answered(lambda to: print_path(to, store, field, result)):
            if json_file is not None:
                write_json(json_file, path_document(store, field, result))
            if tum_file is not None and result.found:
                write_path_as_tum(tum_file, result.poses)
            if plot_file is not None and result.found:
                from ..show.field_page import write_paths_page

                shortest = plan_path(field, start, goal, limit=np.inf, reach=reach)
                ways = {
                    f"position bound at most {limit:g}": result.views,
                    "without the limit": shortest.views,
                }
                write_paths_page(plot_file, field, {name: views for name, views in ways.items() if views})
            if report_file is not None:
                report_path(report_file, context, store, field, result)
        return result.exit_code

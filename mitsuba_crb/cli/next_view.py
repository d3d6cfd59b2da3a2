"""`mitsuba-crb next-view`: which views of a field to add to those that are taken."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .options import BodyFromCamera, Convention, Debug, JsonFile, PlanPlot, Report, Store
from .outcome import answered, foreseen
from .reports import check_report, report_next_views

if TYPE_CHECKING:
    from ..planning.view_field import ViewField


def next_view(
    context: typer.Context,
    store: Store,
    budget: Annotated[int, typer.Option(metavar="K", help="How many views to add.")] = 1,
    have: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|N,N,…",
            help="Views that are taken already: a file of poses that the store has, or the views' numbers.",
        ),
    ] = None,
    objective: Annotated[
        str,
        typer.Option(
            metavar="logdet|lambda_min|trace",
            help="What the views maximise, of the information with translation in length scales.",
        ),
    ] = "logdet",
    prior: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="What is known of the body's pose beforehand (.toml, .json), its origin at the centroid of "
            "the usable views' cameras.",
        ),
    ] = None,
    convention: Convention = None,
    body_from_camera: BodyFromCamera = None,
    json_file: JsonFile = None,
    plot_file: PlanPlot = None,
    report_file: Report = None,
    debug: Debug = False,
) -> None:
    """Which views should be added to those that are taken?

    So that one body that carries them all knows its pose best.
    """
    with foreseen(debug):
        from ..bound.prior import load_prior
        from ..export.targets import check_targets
        from ..planning.next_view import next_views
        from ..planning.view_field import open_field

        inputs = [Path(have)] if have is not None and os.path.exists(have) else []
        targets = {"--json": json_file, "--plot": plot_file, "--report": report_file}
        check_targets(targets, [*inputs, *([prior] if prior else [])])
        check_report(report_file)
        field = open_field(store)
        known = None if prior is None else load_prior(prior)
        taken = _taken(field, have, convention, body_from_camera)
        result = next_views(field, have=taken, budget=budget, objective=objective, prior=known)

        from ..export.documents import write_json
        from ..export.plan_documents import next_views_document
        from ..show.plan_table import print_next_views

        with answered(lambda to: print_next_views(to, store, field, result)):
            if json_file is not None:
                write_json(json_file, next_views_document(store, field, result))
            if plot_file is not None:
                from ..show.field_page import write_next_views_page

                write_next_views_page(plot_file, field, result.chosen, have=result.have)
            if report_file is not None:
                report_next_views(report_file, context, store, field, result)


def _taken(
    field: ViewField, have: str | None, convention: str | None, body_from_camera: str | None
) -> tuple[int, ...]:
    """The views that --have names."""
    from ..datasets.poses import load_poses
    from ..errors import PlanError
    from ..planning.next_view import stored_views
    from .arguments import parse_body_from_camera

    if have is None:
        return ()
    if not os.path.exists(have) and re.fullmatch(r"[\s,]*[0-9][0-9\s,]*", have):
        return tuple(int(number) for number in re.findall(r"\d+", have))
    if not os.path.exists(have):
        raise PlanError(
            f"--have {have}: there is no such file, and these are no numbers of views, such as 3,17"
        )
    body = parse_body_from_camera(body_from_camera, have)
    return stored_views(field, load_poses(Path(have), convention, body_from_camera=body).poses)

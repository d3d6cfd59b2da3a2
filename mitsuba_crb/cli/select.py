"""`mitsuba-crb select`: which image tiles several agents should send under a budget."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from .options import Config, Debug, JsonFile, Report, Variant, Workers
from .outcome import answered, foreseen, measuring
from .reports import check_report, report_selection


def select(
    context: typer.Context,
    config: Config,
    budget: Annotated[int | None, typer.Option(metavar="B", help="Tiles in total.")] = None,
    per_agent: Annotated[
        int | None,
        typer.Option("--per-agent", metavar="b", help="Tiles of each agent, in place of the file's budgets."),
    ] = None,
    size: Annotated[int | None, typer.Option("--bytes", metavar="N", help="Bytes in total.")] = None,
    objective: Annotated[
        Literal["logdet", "trace", "lambda_min"], typer.Option(help="What the tiles maximise.")
    ] = "logdet",
    workers: Workers = None,
    json_file: JsonFile = None,
    plot_folder: Annotated[
        Path | None,
        typer.Option(
            "--plot", metavar="FOLDER", help="Write a picture per agent, and the curve over budgets, as PNG."
        ),
    ] = None,
    report_file: Report = None,
    variant: Variant = None,
    debug: Debug = False,
) -> None:
    """Which image tiles should agents send if they may not send all?"""
    with foreseen(debug, variant):
        from ..agents.tiles import Budget
        from ..export.targets import check_folder, check_targets
        from ..measure.team_file import load_team

        team = load_team(config)
        limits = Budget(tiles=budget, tiles_per_agent=per_agent, bytes=size)
        check_targets({"--json": json_file, "--report": report_file}, team.files)
        check_report(report_file)
        if plot_folder is not None:
            check_folder(plot_folder, "--plot")

        from ..export.documents import selection_document, write_json
        from ..measure.teams import select_team
        from ..show.team_table import print_selection

        with measuring() as (advance, _):  # the result repeats the warnings
            result = select_team(team, limits, objective=objective, workers=workers, on_agent=advance)
        with answered(lambda to: print_selection(to, team, result)):
            if json_file is not None:
                write_json(json_file, selection_document(team, result))
            if plot_folder is not None:
                from ..show.team_page import write_selection_plots

                write_selection_plots(plot_folder, result)
            if report_file is not None:
                report_selection(report_file, context, team, result)

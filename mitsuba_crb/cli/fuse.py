"""`mitsuba-crb fuse`: what several agents know together of their common body's pose."""

from __future__ import annotations

import typer

from .options import Config, Debug, JsonFile, Report, Variant, Workers
from .outcome import answered, foreseen, measuring
from .reports import check_report, report_fusion


def fuse(
    context: typer.Context,
    config: Config,
    workers: Workers = None,
    json_file: JsonFile = None,
    report_file: Report = None,
    variant: Variant = None,
    debug: Debug = False,
) -> None:
    """What do several agents know together of their pose?

    Their common body's, from informations that each measures by itself.
    """
    with foreseen(debug, variant):
        from ..export.targets import check_targets
        from ..measure.team_file import load_team

        team = load_team(config)
        check_targets({"--json": json_file, "--report": report_file}, team.files)
        check_report(report_file)

        from ..export.documents import fusion_document, write_json
        from ..measure.teams import fuse_team
        from ..show.team_table import print_fusion

        with measuring() as (advance, _):  # the result repeats the warnings
            result = fuse_team(team, workers=workers, on_agent=advance)
        with answered(lambda to: print_fusion(to, team, result)):
            if json_file is not None:
                write_json(json_file, fusion_document(team, result))
            if report_file is not None:
                report_fusion(report_file, context, team, result)

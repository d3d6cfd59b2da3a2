"""`--report`: the page of a result, for those who look at it in a browser."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from ..camera import Intrinsics
    from ..measure.outlook import Outlook
    from ..measure.pose_table import PoseTable
    from ..measure.report import BoundReport
    from ..measure.team_file import Team
    from ..measure.teams import TeamFusion, TeamSelection
    from ..planning.next_view import NextViews
    from ..planning.path_search import PathPlan
    from ..planning.view_field import ViewField
    from ..show.report import Origin


def check_report(path: Path | None) -> None:
    """Ask for what writes pages before anything is measured.

    Raises:
        OutputError: a page is asked for, and plotly is not installed.
    """
    if path is not None:
        from ..show.report import plotly_library

        plotly_library()


def report_bound(
    path: Path,
    context: typer.Context,
    report: BoundReport,
    document: Mapping[str, Any],
    scene: Path,
    defines: Mapping[str, str],
    options: Mapping[str, Any],
) -> None:
    """Write the page of one bound."""
    from ..measure.outlook import Looking, outlook
    from ..show.report import write_bound_report

    seen = outlook([Looking(scene, options, defines, images=False)])
    write_bound_report(path, document, report.pictures, seen, _origin(context))


def report_poses(
    path: Path,
    context: typer.Context,
    table: PoseTable,
    scene: Path,
    cameras: Sequence[Intrinsics] | None,
    defines: Mapping[str, str],
    options: Mapping[str, Any],
) -> None:
    """Write the page of many bounds; `cameras` are those of all poses."""
    from ..measure.outlook import Looking, outlook
    from ..show.report import write_poses_report

    own = None if cameras is None else [cameras[place] for place in table.places]
    names = [row.name for row in table.rows]
    seen = outlook([Looking(scene, options, defines, names, [row.pose for row in table.rows], own)])
    write_poses_report(path, table, seen, _origin(context))


def report_validation(
    path: Path,
    context: typer.Context,
    document: Mapping[str, Any],
    scene: Path,
    defines: Mapping[str, str],
    options: Mapping[str, Any],
) -> None:
    """Write the page of trials."""
    from ..measure.outlook import Looking, outlook
    from ..show.report import write_validation_report

    write_validation_report(path, document, outlook([Looking(scene, options, defines)]), _origin(context))


def report_fusion(path: Path, context: typer.Context, team: Team, result: TeamFusion) -> None:
    """Write the page of a team's joint bound."""
    from ..export.documents import fusion_document
    from ..show.report import write_fusion_report

    write_fusion_report(path, fusion_document(team, result), _of_team(team), _origin(context))


def report_selection(path: Path, context: typer.Context, team: Team, result: TeamSelection) -> None:
    """Write the page of a team's chosen tiles."""
    from ..export.documents import selection_document
    from ..show.report import write_selection_report

    write_selection_report(
        path,
        selection_document(team, result),
        [agent.tiles for agent in result.agents],
        result.images,
        _of_team(team, images=False),
        _origin(context),
    )


def report_field(
    path: Path, context: typer.Context, field: ViewField, world: Any, options: Mapping[str, Any]
) -> None:
    """Write the page of a field of views; `world` is loaded."""
    from ..planning.field_outlook import field_outlook
    from ..show.field_page import outlines_of
    from ..show.report import write_field_report

    seen = field_outlook(field, world, options)
    write_field_report(path, field, seen, outlines_of(field, world), _origin(context))


def report_next_views(
    path: Path, context: typer.Context, store: Path, field: ViewField, result: NextViews
) -> None:
    """Write the page of chosen views."""
    from ..planning.field_outlook import field_outlook
    from ..planning.world_at_hand import world_at_hand
    from ..show.report import write_next_views_report

    seen = field_outlook(field, world_at_hand(field))
    write_next_views_report(path, store, field, result, seen, _origin(context))


def report_path(path: Path, context: typer.Context, store: Path, field: ViewField, result: PathPlan) -> None:
    """Write the page of a path."""
    from ..planning.field_outlook import field_outlook
    from ..planning.world_at_hand import world_at_hand
    from ..show.report import write_path_report

    seen = field_outlook(field, world_at_hand(field))
    write_path_report(path, store, field, result, seen, _origin(context))


def _of_team(team: Team, *, images: bool = True) -> Outlook:
    from ..measure.outlook import Looking, outlook

    return outlook(
        [
            Looking(member.scene, team.options(member), member.defines, (member.name,), images=images)
            for member in team.members
        ]
    )


def _origin(context: typer.Context) -> Origin:
    from ..measure.versions import versions
    from ..show.report import Origin

    return Origin(str(context.obj), versions())

"""What a plan over a field of views leaves on disk: a JSON document, and a path as a trajectory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..files import atomic, jsonable
from ..planning.next_view import ONE_BODY
from ..se3 import Array, pose_to_gtsam, vector_from_pose

if TYPE_CHECKING:
    from ..planning.next_view import NextViews
    from ..planning.path_search import PathPlan
    from ..planning.view_field import ViewField

NEXT_VIEW_SCHEMA = "mitsuba-crb/next-view/1"
PATH_SCHEMA = "mitsuba-crb/path/1"


def next_views_document(store: Path, field: ViewField, result: NextViews) -> dict[str, Any]:
    """Chosen views, the bound after each, and the certificate, as strict JSON."""
    document = {
        "schema": NEXT_VIEW_SCHEMA,
        "store": store,
        "unknown": ONE_BODY,
        "objective": result.objective,
        "have": result.have,
        "chosen": [
            {"view": view, "place": field.place[view], "heading": field.heading[view], "pose": pose}
            for view, pose in zip(result.chosen, result.poses, strict=True)
        ],
        "bounds": [
            {
                "views": k,
                "position_bound": result.position_bound[k],
                "position_bound_standard_error": result.position_bound_standard_error[k],
                "rotation_bound_deg": result.rotation_bound_deg[k],
                "rotation_bound_deg_standard_error": result.rotation_bound_deg_standard_error[k],
                "rank": rank,
            }
            for k, rank in enumerate(result.rank)
        ],
        "value": result.value,
        "value_empty": result.value_empty,
        "upper_bound": result.upper_bound,
        "certificate": result.certificate,
        "guarantee": result.guarantee,
        "usable": result.usable,
        "body": result.body,
        "length_scale": result.length_scale,
        "ridge": result.ridge,
        "settings": field.settings,
    }
    plain: dict[str, Any] = jsonable(document)
    return plain


def path_document(store: Path, field: ViewField, result: PathPlan) -> dict[str, Any]:
    """A path, or that there is none, as strict JSON."""
    document = {
        "schema": PATH_SCHEMA,
        "store": store,
        "from": result.start,
        "to": result.goal,
        "limit": result.limit,
        "odometry": None if result.odometry is None else vars(result.odometry),
        "found": result.found,
        "length": result.length,
        "shortest": result.shortest,
        "smallest_limit": result.smallest_limit,
        "heuristic": result.dropped > 0,
        "dropped": result.dropped,
        "dropped_below": result.dropped_below,
        "length_lower_limit": result.length_lower_limit,
        "steps": [
            {"place": place, "view": view, "pose": pose, "before": before, "after": after}
            for place, view, pose, before, after in zip(
                result.places, result.views, result.poses, result.before, result.after, strict=True
            )
        ],
        "neighbourhood": result.neighbourhood,
        "settings": field.settings,
    }
    plain: dict[str, Any] = jsonable(document)
    return plain


def write_path_as_tum(path: Path, poses: Array) -> None:
    """Write poses (n, 4, 4), `world_from_camera`, as TUM does, one a second: camera axes x right, y down."""
    rows = [
        " ".join([str(second), *(f"{value:.9g}" for value in vector_from_pose(pose_to_gtsam(pose)))])
        for second, pose in enumerate(poses)
    ]
    text = "\n".join(["# timestamp tx ty tz qx qy qz qw", *rows]) + "\n"
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")

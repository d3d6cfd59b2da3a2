"""What a run leaves on disk: a JSON document and a multi-channel OpenEXR image.

Every file is written beside its destination and moved there in one step, so that an interrupted run
leaves the old file or none, never half of one. `check_target` asks the folder before anything is
rendered.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..files import atomic, jsonable

if TYPE_CHECKING:
    from ..agents.selection import TileSelection
    from ..agents.team import Team
    from ..bound.cramer_rao import PoseBound
    from ..bound.hcr import HCRBound
    from ..measure.teams import TeamFusion, TeamSelection

SCHEMA = "mitsuba-crb/bound/1"
FUSE_SCHEMA = "mitsuba-crb/fuse/1"
SELECT_SCHEMA = "mitsuba-crb/select/1"


_BREAK = re.compile(r",\n\s*")
_PROVENANCE_KEYS = (
    "scene",
    "defines",
    "sensor",
    "method",
    "spp",
    "seed",
    "batches",
    "size",
    "pixels",
    "noise",
    "prior",
)
_BOUND_KEYS = (
    "frame",
    "twist_order",
    "units",
    "length_scale",
    "information",
    "information_standard_error",
    "covariance",
    "position_std",
    "position_std_standard_error",
    "rotation_std_deg",
    "rotation_std_deg_standard_error",
    "eigenvalues",
    "eigenvalues_standard_error",
    "rank",
    "unobserved",
    "weakest",
    "optimality",
)


def bound_document(bound: PoseBound, hcr: HCRBound | None = None) -> dict[str, Any]:
    """The bound, its provenance and the one beyond it as strict JSON: infinity is "inf", no number None."""
    values, provenance = bound.to_dict(), bound.provenance
    document = {
        "schema": SCHEMA,
        **{key: provenance.get(key) for key in _PROVENANCE_KEYS},
        "pose": bound.information.pose,
        **{key: values[key] for key in _BOUND_KEYS},
        "nuisances": values["nuisances"],
        "noise_inflation": provenance.get("noise_inflation"),
        "finite_differences": provenance.get("finite_differences"),
        "warnings": provenance.get("warnings", []),
        "versions": provenance.get("versions", {}),
        "seconds": provenance.get("seconds", {}),
    }
    if hcr is not None:
        document["hcr"] = hcr.to_dict()
    plain: dict[str, Any] = jsonable(document)
    return plain


def fusion_document(team: Team, result: TeamFusion) -> dict[str, Any]:
    """A team's joint bound, each agent's share and how it was measured, as strict JSON."""
    values = result.fusion.to_dict()
    agents = [
        {**share, **{key: bound.provenance.get(key) for key in (*_PROVENANCE_KEYS, "warnings")}}
        for share, bound in zip(values["agents"], result.bounds, strict=True)
    ]
    document = {
        "schema": FUSE_SCHEMA,
        "config": team.path,
        "body": team.body,
        "pose": result.fusion.information.pose,
        **{key: values[key] for key in _BOUND_KEYS},
        "agents": agents,
        "warnings": result.warnings,
        "versions": result.bounds[0].provenance.get("versions", {}),
    }
    plain: dict[str, Any] = jsonable(document)
    return plain


def selection_document(team: Team, result: TeamSelection) -> dict[str, Any]:
    """A team's chosen tiles, their worth, bounds and other budgets, as strict JSON."""
    document = {
        "schema": SELECT_SCHEMA,
        "config": team.path,
        "body": team.body,
        "length_scale": result.agents[0].length_scale,
        **result.selection.to_dict(),
        "agents": [
            {"name": agent.agent, "tiles": agent.tiles, "cost_bytes": agent.cost_bytes}
            for agent in result.agents
        ],
        "curve": [{result.counts: budget, **_worth(other)} for budget, other in result.curve],
        "warnings": result.warnings,
    }
    plain: dict[str, Any] = jsonable(document)
    return plain


def _worth(selection: TileSelection) -> dict[str, Any]:
    values = selection.to_dict()
    return {key: values[key] for key in ("value", "value_heldout", "upper_bound", "baselines")}


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write `document`, which holds no infinity and no NaN (see `bound_document`), as UTF-8 JSON."""
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    # innermost lists on one line, so that a matrix looks like one; JSON strings hold no raw line breaks
    text = re.sub(r"\[\n\s*([^\[\]{}]*?)\n\s*\]", lambda found: f"[{re.sub(_BREAK, ', ', found[1])}]", text)
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")

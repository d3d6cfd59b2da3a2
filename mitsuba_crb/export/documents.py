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
from typing import TYPE_CHECKING, Any, Literal

from ..files import atomic, jsonable
from ..se3 import TWIST_ORDER, vector_from_pose

if TYPE_CHECKING:
    from ..agents.selection import TileSelection
    from ..bound.cramer_rao import PoseBound
    from ..bound.hcr import HCRBound
    from ..bound.misspecified import MisspecifiedCovariance
    from ..estimate.photograph import PhotographAlignment
    from ..estimate.trials import Validation
    from ..information.joint import JointInformation
    from ..measure.held_out import HeldOut
    from ..measure.team_file import Team
    from ..measure.teams import TeamFusion, TeamSelection

SCHEMA = "mitsuba-crb/bound/1"
FUSE_SCHEMA = "mitsuba-crb/fuse/1"
SELECT_SCHEMA = "mitsuba-crb/select/1"
ALIGN_SCHEMA = "mitsuba-crb/align/1"


_BREAK = re.compile(r",\n\s*")
_PROVENANCE_KEYS = (
    "scene",
    "defines",
    "sensor",
    "camera",
    "projection",
    "camera_scaled_from",
    "method",
    "spp",
    "seed",
    "batches",
    "sampling",
    "size",
    "fov_deg",
    "pixels",
    "measures",
    "noise",
    "depth",
    "prior",
)
_OF_FIELDS = ("field", "deterministic", "photograph")


def bound_document(
    bound: PoseBound,
    hcr: HCRBound | None = None,
    misspecified: MisspecifiedCovariance | None = None,
    held_out: HeldOut | None = None,
) -> dict[str, Any]:
    """The bound, its provenance and those beside it as strict JSON: infinity is "inf", no number None."""
    provenance = bound.provenance
    document = {
        "schema": SCHEMA,
        **{key: provenance.get(key) for key in _PROVENANCE_KEYS},
        **{key: provenance[key] for key in _OF_FIELDS if key in provenance},
        "pose": bound.information.pose,
        **_bound(bound),
        "nuisances": {
            "how": provenance.get("nuisances", {}),
            "joint": _joint(bound.joint) if bound.joint is not None and bound.joint.names else None,
            "if_known": {
                name: {"position_std": known.position_std, "rotation_std_deg": known.rotation_std_deg}
                for name, known in bound.if_known.items()
            },
        },
        "noise_inflation": provenance.get("noise_inflation"),
        "finite_differences": provenance.get("finite_differences"),
        "no_bound": provenance.get("no_bound", []),
        "warnings": provenance.get("warnings", []),
        "versions": provenance.get("versions", {}),
        "seconds": provenance.get("seconds", {}),
    }
    if hcr is not None:
        document["hcr"] = {
            "position_std": hcr.position_std,
            "rotation_std_deg": hcr.rotation_std_deg,
            "covariance": hcr.covariance,
            "displacements": hcr.displacements,
            "squared_distances": hcr.squared_distances,
            "squared_distances_standard_error": hcr.squared_distances_standard_error,
            "repeats": hcr.repeats,
        }
    if misspecified is not None:
        document["misspecified"] = _misspecified(misspecified)
    if held_out is not None:
        document["held_out"] = _held_out(held_out)
    plain: dict[str, Any] = jsonable(document)
    return plain


def fusion_document(team: Team, result: TeamFusion) -> dict[str, Any]:
    """A team's joint bound, each agent's share and how it was measured, as strict JSON."""
    agents = [
        {
            "name": agent.name,
            "rank": agent.rank,
            "share": agent.share,
            "pose": bound.information.pose,
            "unobserved": [vars(direction) for direction in bound.unobserved],
            "ellipsoids": _ellipsoids(bound),
            **{key: bound.provenance.get(key) for key in (*_PROVENANCE_KEYS, "warnings")},
        }
        for agent, bound in zip(result.fusion.agents, result.bounds, strict=True)
    ]
    document = {
        "schema": FUSE_SCHEMA,
        "config": team.path,
        "body": team.body,
        "pose": result.fusion.information.pose,
        **_bound(result.fusion.bound),
        "agents": agents,
        "warnings": result.warnings,
        "versions": result.bounds[0].provenance.get("versions", {}),
    }
    plain: dict[str, Any] = jsonable(document)
    return plain


def selection_document(team: Team, result: TeamSelection) -> dict[str, Any]:
    """A team's chosen tiles, their worth, bounds and other budgets, as strict JSON."""
    selection = result.selection
    document = {
        "schema": SELECT_SCHEMA,
        "config": team.path,
        "body": team.body,
        "length_scale": result.agents[0].length_scale,
        "objective": selection.objective,
        "chosen": [vars(chosen) for chosen in selection.chosen],
        "value": selection.value,
        "value_heldout": selection.value_heldout,
        "value_empty": selection.value_empty,
        "upper_bound": selection.upper_bound,
        "certificate": selection.certificate,
        "guarantee": selection.guarantee,
        "baselines": _baselines(selection),
        "total_bytes": selection.total_bytes,
        "evaluations": selection.evaluations,
        "agents": [
            {"name": agent.agent, "tiles": agent.tiles, "cost_bytes": agent.cost_bytes}
            for agent in result.agents
        ],
        "curve": [
            {
                result.counts: budget,
                "value": other.value,
                "value_heldout": other.value_heldout,
                "upper_bound": other.upper_bound,
                "baselines": _baselines(other),
            }
            for budget, other in result.curve
        ],
        "warnings": result.warnings,
    }
    plain: dict[str, Any] = jsonable(document)
    return plain


def validation_document(result: Validation) -> dict[str, Any]:
    """Trials and what they say of the bound as strict JSON; `validate` resumes from it."""
    from ..estimate.trial_record import SCHEMA  # is loaded with the result; other documents need no Mitsuba

    found = result.consistency
    document = {
        "schema": SCHEMA,
        "settings": result.settings,
        "bound": _bound(result.bound),
        "trials": len(result.trials),
        "converged": len(result.trials) - len(result.failed),
        "failed": result.failed,
        "nees": found.nees,
        "nees_band": found.nees_band,
        "generalized_eigenvalues": found.generalized_eigenvalues,
        "directions": found.directions,
        "wishart_band": found.wishart_band,
        "coverage": [vars(coverage) for coverage in found.coverage],
        "bias": found.bias,
        "verdict": result.verdict,
        "cure": result.cure,
        "efficiency": result.efficiency,
        "excess": result.excess,
        "bound_uncertainty": result.renderer.uncertainty,
        "freed_nees": result.renderer.freed.nees,
        "freed_generalized_eigenvalues": result.renderer.freed.generalized_eigenvalues,
        "rmse_position": result.rmse_position,
        "rmse_rotation_deg": result.rmse_rotation_deg,
        "bound_position": result.bound_position,
        "bound_rotation_deg": result.bound_rotation_deg,
        "results": [vars(trial) for trial in (*result.trials, *result.further)],
    }
    plain: dict[str, Any] = jsonable(document)
    return plain


def alignment_document(result: PhotographAlignment) -> dict[str, Any]:
    """Where a photograph was taken from, what that is worth, and the other starts, as strict JSON."""
    found = result.alignment
    document = {
        "schema": ALIGN_SCHEMA,
        **result.settings,
        "verdict": result.verdict,
        "status": found.status,
        "iterations": found.iterations,
        "pose": found.pose,
        "position_and_quaternion": vector_from_pose(found.pose),
        "residual_rms": found.rms,
        "residual_unit": "display values, white is 1" if result.display else "linear values, white is 1",
        "psnr_db": result.psnr_db,
        "even_psnr_db": result.even_psnr_db,
        "tone": {"fitted": found.tone.kind, "gain": found.tone.gain, "black": found.tone.black},
        "noise": {**found.noise, "origin": result.settings["noise"]},
        "pixels": {
            **vars(found.bound.information.selection),
            "masked": result.measured.masked,
            "saturated": result.measured.saturated,
            "invalid": found.invalid,
        },
        "ideal": _bound(found.bound),
        "covariance_of_renderer": found.added,
        "excess": found.excess,
        "misspecified": None if found.misspecified is None else _misspecified(found.misspecified),
        "held_out": None if result.held_out is None else _held_out(result.held_out),
        "candidates": [
            {**vars(candidate), "moved": candidate.moved[0], "turned_deg": candidate.moved[1]}
            for candidate in result.candidates
        ],
    }
    plain: dict[str, Any] = jsonable(document)
    return plain


def _misspecified(found: MisspecifiedCovariance) -> dict[str, Any]:
    names = (
        "covariance",
        "position_std",
        "position_std_standard_error",
        "rotation_std_deg",
        "rotation_std_deg_standard_error",
        "residuals",
        "gap",
    )
    return {
        "frame": found.ideal.frame,
        "ratios_to_ideal": found.ratios,
        **{name: getattr(found, name) for name in names},
    }


def _held_out(found: HeldOut) -> dict[str, Any]:
    return {
        "names": found.names,
        "residual_rms": found.rms,
        "gain": [tone.gain for tone in found.tones],
        "black": [tone.black for tone in found.tones],
    }


def _bound(bound: PoseBound) -> dict[str, Any]:
    return {
        "frame": bound.frame,
        "twist_order": TWIST_ORDER,
        "units": {
            "twist": ["scene unit"] * 3 + ["rad"] * 3,
            "position_std": "scene unit",
            "rotation_std_deg": "deg",
            "eigenvalues": "camera frame, translation in units of length_scale",
            "ellipsoids.position": "scene unit, along world axes",
            "ellipsoids.rotation": "deg, about camera axes",
            "unobserved.std_lower_limit": "as unobserved.direction, unit twist",
            "unobserved.direction": "camera frame, translation in units of length_scale",
        },
        "length_scale": bound.length_scale,
        "information": bound.information.matrix,
        "information_standard_error": bound.information.standard_error,
        "covariance": bound.covariance,
        "position_std": bound.position_std,
        "position_std_standard_error": bound.position_std_standard_error,
        "rotation_std_deg": bound.rotation_std_deg,
        "rotation_std_deg_standard_error": bound.rotation_std_deg_standard_error,
        "position_verdict": bound.position_verdict,
        "rotation_verdict": bound.rotation_verdict,
        "position_std_lower_limit": bound.position_std_lower_limit,
        "rotation_std_deg_lower_limit": bound.rotation_std_deg_lower_limit,
        "eigenvalues": bound.eigenvalues,
        "eigenvalues_standard_error": bound.eigenvalues_standard_error,
        "rank": bound.rank,
        "unobserved": [vars(direction) for direction in bound.unobserved],
        "weakest": None if bound.weakest is None else vars(bound.weakest),
        "optimality": vars(bound.optimality),
        "ellipsoids": _ellipsoids(bound),
    }


def _ellipsoids(bound: PoseBound) -> dict[str, Any]:
    """Semi-axes at one standard deviation, longest first, their directions in rows, and their verdicts."""
    found: dict[str, Any] = {}
    kinds: tuple[Literal["position", "rotation"], ...] = ("position", "rotation")
    for kind in kinds:
        semi_axes, directions = bound.ellipsoid(kind)
        found[kind] = {
            "semi_axes": semi_axes,
            "directions": directions.T,
            "verdicts": bound.verdicts_along(kind, directions),
        }
    return found


def _joint(joint: JointInformation) -> dict[str, Any]:
    return {
        "parameters": joint.parameters,
        "per_tile": joint.per_tile,
        "matrix": joint.matrix,
        "treatment": joint.treatment,
    }


def _baselines(selection: TileSelection) -> dict[str, Any]:
    return {name: vars(baseline) for name, baseline in selection.baselines.items()}


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write `document`, which holds no infinity and no NaN (see `bound_document`), as UTF-8 JSON."""
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    # innermost lists on one line, so that a matrix looks like one; JSON strings hold no raw line breaks
    text = re.sub(r"\[\n\s*([^\[\]{}]*?)\n\s*\]", lambda found: f"[{re.sub(_BREAK, ', ', found[1])}]", text)
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")

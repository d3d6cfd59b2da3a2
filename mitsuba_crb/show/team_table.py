"""What a team knows together, and which tiles it should send, on the terminal."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from .bound_table import print_deviations, print_not_resolved, unobserved_facts
from .terminal import new_table, print_facts, print_line, print_notes

if TYPE_CHECKING:
    from ..measure.team_file import Team
    from ..measure.teams import TeamFusion, TeamSelection


def print_fusion(console: Console, team: Team, result: TeamFusion) -> None:
    """What each agent sees and brings, and the joint bound."""
    print_line(console, Text(team.path.name, style="bold"), f"  {len(team.members)} agents")
    table = new_table()
    for head in ("agent", "rank", "share", "unseen alone"):
        table.add_column(head, justify="right" if head in ("rank", "share") else "left")
    for share, bound in zip(result.fusion.agents, result.bounds, strict=True):
        unseen = "; ".join(
            f"{direction.description}{' (not resolved)' if direction.verdict != 'unseen' else ''}"
            for direction in bound.unobserved
        )
        table.add_row(Text(share.name), f"{share.rank} of 6", f"{share.share:.1%}", unseen or "nothing")
    console.print(table)
    bound = result.fusion.bound
    print_not_resolved(console, bound)
    print_line(
        console, f"No unbiased estimator of the pose of {team.body!r} from all images has less than these:"
    )
    print_deviations(console, bound, "body")
    rows = [("rank", f"{bound.rank} of 6")]
    rows += unobserved_facts(bound)
    rows.append(("length scale", f"{bound.length_scale:.4g} scene units (the largest of the agents')"))
    rows += _whites([bound.provenance["noise"] for bound in result.bounds])
    print_facts(console, rows)
    print_notes(console, result.warnings)


def print_selection(console: Console, team: Team, result: TeamSelection) -> None:
    """How many tiles each agent sends, what they are worth beside simpler rules, and other budgets."""
    selection = result.selection
    counts = Counter(chosen.agent for chosen in selection.chosen)
    print_line(
        console,
        Text(team.path.name, style="bold"),
        f"  {len(selection.chosen)} of {sum(len(a.tiles) for a in result.agents)} tiles chosen, "
        f"{selection.total_bytes} bytes",
    )
    table = new_table()
    table.add_column("agent")
    for head in ("tiles", "of", "bytes each"):
        table.add_column(head, justify="right")
    for agent in result.agents:
        costs = sorted(set(agent.cost_bytes.tolist()))
        table.add_row(
            Text(agent.agent),
            str(counts[agent.agent]),
            str(len(agent.tiles)),
            "–".join(map(str, costs[:: max(1, len(costs) - 1)])),
        )
    console.print(table)
    table = new_table()
    table.add_column(selection.objective)
    for head in ("on the half chosen by", "held out"):
        table.add_column(head, justify="right")
    table.add_row("nothing sent", *2 * (_number(selection.value_empty),))
    for name, base in selection.baselines.items():
        table.add_row(name.replace("_", " "), _number(base.value), _number(base.value_heldout))
    table.add_row(
        Text("chosen", style="bold"),
        Text(_number(selection.value), style="bold"),
        Text(_number(selection.value_heldout), style="bold"),
    )
    table.add_row("upper bound", _number(selection.upper_bound), "")
    console.print(table)
    guarantee = "nothing" if selection.guarantee is None else f"{selection.guarantee:.1%}"
    rows = [("certificate", f"{selection.certificate:.1%} of the best gain; beforehand certain: {guarantee}")]
    length = result.agents[0].length_scale
    rows.append(("length scale", f"{length:.4g} scene units (the largest of the agents')"))
    print_facts(console, rows)
    table = new_table()
    for head in (result.counts, "chosen", *selection.baselines, "upper bound"):
        table.add_column(head.replace("_", " "), justify="right")
    for budget, other in result.curve:
        values = (other.value, *(base.value for base in other.baselines.values()), other.upper_bound)
        table.add_row(str(budget), *map(_number, values))
    console.print(table)
    print_notes(console, result.warnings)


def _whites(noises: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """What the agents' cameras are exposed to, of those that saturate."""
    whites = {noise["white"] for noise in noises if "white" in noise}
    if not whites:
        return []
    if len(whites) == 1:
        return [("white", f"{min(whites):.3g}, one exposure for all views")]
    return [("white", f"{min(whites):.3g} to {max(whites):.3g}, an exposure for each view")]


def _number(value: float) -> str:
    return f"{value:.5g}" if math.isfinite(value) else str(value).replace("inf", "∞")

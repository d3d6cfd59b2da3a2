"""Tile selection against enumeration of all subsets, its guarantees, its bounds, and what it refuses."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from rigs import about
from scipy.optimize import linprog

from mitsuba_crb.agents.greedy import choose, greedy
from mitsuba_crb.agents.relaxation import _by_simplex, _by_sorting, upper_bound
from mitsuba_crb.agents.selection import select_tiles
from mitsuba_crb.agents.tiles import Budget, Limits, Problem, TileInformation, limits_of
from mitsuba_crb.bound.criteria import LAMBDA_MIN, OBJECTIVES, KieferMean, LogDet, Trace
from mitsuba_crb.errors import FrameError, SelectionError

KINDS = ("full rank", "few rows", "one row", "lopsided")


def random_tile(rng: np.random.Generator, kind: str) -> np.ndarray:
    if kind == "full rank":
        J = rng.normal(size=(20, 6)) * rng.lognormal(0.0, 1.0)
    elif kind == "few rows":
        J = rng.normal(size=(rng.integers(1, 4), 6)) * rng.lognormal(0.0, 1.0)
    elif kind == "one row":
        J = 10.0 * rng.normal(size=(1, 6))
    else:
        J = rng.normal(size=(12, 6)) * np.exp(1.5 * rng.normal(size=6))
    return J.T @ J


def problem_of(
    blocks, *, agent=None, cost=None, tiles=np.inf, agent_tiles=np.inf, size=np.inf, agent_size=np.inf
) -> Problem:
    blocks = np.asarray(blocks, dtype=np.float64)
    owner = np.zeros(len(blocks), dtype=np.int64) if agent is None else np.asarray(agent)
    agents = int(owner.max()) + 1
    limits = Limits(np.full(agents, float(agent_tiles)), np.full(agents, float(agent_size)), tiles, size)
    cost = np.full(len(blocks), 100.0) if cost is None else np.asarray(cost, dtype=np.float64)
    return Problem(np.eye(6), blocks, owner, cost, limits)


def random_problem(rng: np.random.Generator, kind: str, n: int, *, costs: bool = False, **limits) -> Problem:
    blocks = [random_tile(rng, kind) for _ in range(n)]
    agent = np.concatenate([np.arange(3), rng.integers(0, 3, n - 3)])
    cost = rng.integers(20, 200, n) if costs else None
    return problem_of(blocks, agent=agent, cost=cost, **limits)


def best_value(problem: Problem, objective: str) -> float:
    """The oracle: the largest value over all subsets within the limits, written independently."""
    n = len(problem)
    subsets = (np.arange(2**n)[:, None] >> np.arange(n)) & 1
    limits = problem.limits
    allowed = (subsets.sum(axis=1) <= limits.tiles) & (subsets @ problem.cost <= limits.bytes)
    for a in range(len(limits.agent_tiles)):
        own = problem.agent == a
        allowed &= subsets[:, own].sum(axis=1) <= limits.agent_tiles[a]
        allowed &= subsets[:, own] @ problem.cost[own] <= limits.agent_bytes[a]
    matrices = problem.base + np.tensordot(subsets[allowed].astype(float), problem.blocks, 1)
    if objective == "logdet":
        return float(np.linalg.slogdet(matrices).logabsdet.max())
    if objective == "trace":
        return float(np.trace(matrices, axis1=1, axis2=2).max())
    return float(np.linalg.eigvalsh(matrices)[:, 0].max())


def value_of(problem: Problem, tiles, objective: str) -> float:
    return float(OBJECTIVES[objective].value(problem.information(tiles)))


def within(limits: Limits, problem: Problem, tiles) -> bool:
    chosen = list(tiles)
    counts = np.bincount(problem.agent[chosen], minlength=len(limits.agent_tiles))
    sizes = np.bincount(problem.agent[chosen], problem.cost[chosen], minlength=len(limits.agent_tiles))
    return bool(
        len(set(chosen)) == len(chosen) <= limits.tiles
        and sizes.sum() <= limits.bytes
        and (counts <= limits.agent_tiles).all()
        and (sizes <= limits.agent_bytes).all()
    )


# --- 200 random instances beside enumeration ---


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("objective", list(OBJECTIVES))
def test_for_counts_choices_reach_nine_tenths_of_the_optimum_and_certificates_are_close(objective, kind):
    rng = np.random.default_rng(20)
    criterion = OBJECTIVES[objective]
    for index in range(50):
        # In turns one cardinality, and limits per agent and in total.
        per_agent = np.inf if index % 2 else 2.0
        problem = random_problem(rng, kind, 10, tiles=float(3 + index % 4), agent_tiles=per_agent)
        tiles = choose(problem.simplified(), criterion).tiles
        empty = value_of(problem, [], objective)
        gain, best = value_of(problem, tiles, objective) - empty, best_value(problem, objective) - empty
        assert within(problem.limits, problem, tiles)
        assert gain >= 0.9 * best - 1e-9
        if objective == "trace":
            assert gain == pytest.approx(best, rel=1e-12)
        if objective != "lambda_min":
            bound = upper_bound(problem, criterion, gain + empty) - empty
            assert best * (1.0 - 1e-12) <= bound <= 1.05 * best


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("objective", ["logdet", "trace"])
@pytest.mark.parametrize(
    "limits",
    [
        {"size": 500.0},
        {"size": 600.0, "agent_size": 250.0},
        {"tiles": 4.0, "size": 500.0},
    ],
    ids=["bytes", "bytes per agent", "tiles and bytes"],
)
def test_for_bytes_certificates_are_valid_and_within_five_percent_of_the_optimum(objective, kind, limits):
    rng = np.random.default_rng(21)
    criterion = OBJECTIVES[objective]
    for _ in range(4):
        problem = random_problem(rng, kind, 10, costs=True, **limits)
        simple = problem.simplified()
        value = value_of(simple, choose(simple, criterion).tiles, objective)
        bound = upper_bound(simple, criterion, value)
        empty, best = value_of(problem, [], objective), best_value(problem, objective)
        assert value <= best + 1e-9 * abs(best)
        assert best * (1.0 - 1e-12) <= bound
        assert bound - empty <= 1.05 * (best - empty)


@pytest.mark.parametrize("kind", KINDS)
def test_certificates_of_the_smallest_eigenvalue_are_valid(kind):
    rng = np.random.default_rng(22)
    for limits in ({"tiles": 6.0}, {"tiles": 5.0, "agent_tiles": 2.0}):
        problem = random_problem(rng, kind, 10, **limits).simplified()
        best = best_value(problem, "lambda_min")
        bound = upper_bound(problem, LAMBDA_MIN, best)
        assert best * (1.0 - 1e-12) <= bound
        # Loose where few tiles of low rank are sent; close where every tile sees all directions.
        assert kind != "full rank" or bound - 1.0 <= 1.25 * (best - 1.0)


@pytest.mark.slow
def test_a_certificate_of_many_tiles_needs_no_branching():
    rng = np.random.default_rng(23)
    problem = random_problem(rng, "few rows", 1000, tiles=60.0)
    for objective, criterion in OBJECTIVES.items():
        value = value_of(problem, choose(problem, criterion).tiles, objective)
        bound = upper_bound(problem, criterion, value)
        assert value <= bound <= value + 0.05 * (value - value_of(problem, [], objective))


# --- greedy and lazy greedy ---


@pytest.mark.parametrize("objective", ["logdet", "trace"])
@pytest.mark.parametrize("per_byte", [False, True])
def test_lazy_greedy_chooses_the_same_tiles_in_the_same_order(objective, per_byte):
    rng = np.random.default_rng(24)
    criterion = OBJECTIVES[objective]
    for kind, limits in itertools.product(
        KINDS, ({"tiles": 12.0}, {"tiles": 12.0, "agent_tiles": 5.0}, {"size": 900.0, "agent_size": 400.0})
    ):
        problem = random_problem(rng, kind, 60, costs=True, **limits)
        lazy = greedy(problem, criterion, per_byte=per_byte)
        plain = greedy(problem, criterion, per_byte=per_byte, lazy=False)
        assert lazy.tiles == plain.tiles
        assert lazy.evaluations < plain.evaluations


def test_equal_and_empty_tiles_are_chosen_in_their_order_by_both():
    rng = np.random.default_rng(25)
    blocks = np.zeros((30, 6, 6))
    blocks[10:20] = random_tile(rng, "few rows")
    blocks[20:] = random_tile(rng, "one row")
    problem = problem_of(blocks, tiles=25.0)
    lazy, plain = (greedy(problem, LogDet(), lazy=lazy) for lazy in (True, False))
    assert lazy.tiles == plain.tiles
    assert lazy.tiles[-5:] == (0, 1, 2, 3, 4)
    assert sorted(lazy.tiles[:20]) == list(range(10, 30))


def test_lazy_greedy_evaluates_a_small_fraction():
    rng = np.random.default_rng(26)
    problem = random_problem(rng, "full rank", 4000, tiles=200.0)
    plain_evaluations = sum(4000 - chosen for chosen in range(200))
    assert greedy(problem, LogDet()).evaluations < plain_evaluations / 40


@pytest.mark.parametrize("kind", KINDS)
def test_pruned_rounds_choose_the_same_tiles_by_criteria_that_are_not_submodular(kind):
    rng = np.random.default_rng(27)
    problem = random_problem(rng, kind, 300, tiles=15.0)
    for criterion in (LAMBDA_MIN, KieferMean(1.0), KieferMean(16.0)):
        pruned, plain = (greedy(problem, criterion, lazy=lazy) for lazy in (True, False))
        assert pruned.tiles == plain.tiles
        assert pruned.evaluations <= plain.evaluations


def test_smallest_eigenvalue_starts_from_rank_deficient_tiles_and_uses_the_full_budget():
    # Tiles that see one direction each, ten per direction: no five of them raise λ_min at all.
    blocks = np.zeros((60, 6, 6))
    blocks[np.arange(60), np.arange(60) % 6, np.arange(60) % 6] = 1.0 + np.arange(60) / 60.0
    problem = problem_of(blocks, tiles=12.0)
    assert value_of(problem, greedy(problem, LAMBDA_MIN).tiles[:5], "lambda_min") == 1.0
    tiles = choose(problem, LAMBDA_MIN).tiles
    assert len(tiles) == 12
    # Two tiles of every direction, the best ones.
    assert sorted(tiles) == list(range(48, 60))
    starved = choose(problem_of(blocks, tiles=5.0), LAMBDA_MIN).tiles
    assert len(starved) == 5
    assert np.linalg.matrix_rank(blocks[list(starved)].sum(axis=0)) == 5


# --- an adversarial instance for each guarantee ---


def diagonal(*entries: float) -> np.ndarray:
    return np.diag(np.array(entries, dtype=np.float64))


def greedy_ratio(problem: Problem, objective: str, *, per_byte: bool = False) -> float:
    tiles = greedy(problem, OBJECTIVES[objective], per_byte=per_byte).tiles
    empty = value_of(problem, [], objective)
    return (value_of(problem, tiles, objective) - empty) / (best_value(problem, objective) - empty)


def test_one_cardinality_holds_one_minus_one_over_e_where_greedy_is_tempted():
    # The first tile overlaps half of each of the two that together see four directions.
    s = 1e6
    problem = problem_of(
        [diagonal(2 * s, 0, 2 * s, 0, 0, 0), diagonal(s, s, 0, 0, 0, 0), diagonal(0, 0, s, s, 0, 0)],
        tiles=2.0,
    )
    assert 1.0 - math.exp(-1.0) <= greedy_ratio(problem, "logdet") < 0.8
    assert sorted(choose(problem, LogDet()).tiles) == [1, 2]  # by an exchange


def test_limits_per_agent_hold_one_half_but_not_one_minus_one_over_e():
    # Agent 0's slightly better tile is what agent 1 has to say anyway.
    s = 1e8
    x, y = diagonal(s, 0, 0, 0, 0, 0), diagonal(0, s, 0, 0, 0, 0)
    problem = problem_of([1.01 * x, y, x], agent=[0, 0, 1], tiles=2.0, agent_tiles=1.0)
    assert 0.5 <= greedy_ratio(problem, "logdet") < 1.0 - math.exp(-1.0)
    assert sorted(choose(problem, LogDet()).tiles) == [1, 2]


def test_trace_is_optimal_where_agents_compete_for_the_total():
    traces = np.array([9.0, 8.0, 7.0, 6.5, 6.0, 1.0])
    problem = problem_of(
        traces[:, None, None] * np.eye(6), agent=[0, 0, 0, 0, 1, 2], tiles=4.0, agent_tiles=2.0
    )
    assert greedy(problem, Trace()).tiles == (0, 1, 4, 5)
    assert greedy_ratio(problem, "trace") == 1.0


@pytest.mark.parametrize(("objective", "guarantee"), [("logdet", 0.5 * (1 - math.exp(-1.0))), ("trace", 0.5)])
def test_under_bytes_each_greedy_order_fails_alone_but_not_the_better_one(objective, guarantee):
    # By gain, one large tile beats each of many small ones; by gain per byte, a tiny one blocks a large one.
    small = [diagonal(*np.eye(6)[i] * 1e3) for i in range(6)]
    large = problem_of([diagonal(1.1e3, 0, 0, 0, 0, 0), *small], cost=[600, *[100] * 6], size=600.0)
    tiny = problem_of([diagonal(20, 0, 0, 0, 0, 0), 1e3 * np.eye(6)], cost=[1, 600], size=600.0)
    assert greedy_ratio(large, objective) < guarantee
    assert greedy_ratio(tiny, objective, per_byte=True) < guarantee
    for problem in (large, tiny):
        gain = value_of(problem, choose(problem, OBJECTIVES[objective]).tiles, objective)
        assert gain == pytest.approx(best_value(problem, objective))


def test_greedy_by_the_smallest_eigenvalue_alone_has_no_guarantee():
    # A tile that sees a little of everything beats, at first, each of six that see one direction well.
    blocks = [*(1e-3 * np.eye(6),) * 6, *(diagonal(*np.eye(6)[i] * 100.0) for i in range(6))]
    problem = problem_of(blocks, tiles=6.0)
    assert greedy_ratio(problem, "lambda_min") < 1e-3
    assert sorted(choose(problem, LAMBDA_MIN).tiles) == [6, 7, 8, 9, 10, 11]


@pytest.mark.parametrize(
    ("budget", "costs", "logdet", "trace"),
    [
        (Budget(tiles=4), [100], 1 - math.exp(-1), 1.0),
        (Budget(tiles=4, tiles_per_agent=2), [100], 0.5, 1.0),
        (Budget(tiles=4, tiles_per_agent=4), [100], 1 - math.exp(-1), 1.0),
        (Budget(bytes=450), [100], 1 - math.exp(-1), 1.0),
        (Budget(bytes=450), [90, 110], 0.5 * (1 - math.exp(-1)), 0.5),
        (Budget(bytes=450, bytes_per_agent=250), [90, 110], None, None),
        (Budget(bytes=450, tiles=4), [90, 110], None, None),
        (Budget(tiles=1000), [100], 1.0, 1.0),
    ],
)
def test_the_guarantee_follows_from_the_limits_that_can_bind(budget, costs, logdet, trace):
    agents = agents_of(np.random.default_rng(28), costs=costs)
    assert select_tiles(agents, budget).guarantee == logdet
    assert select_tiles(agents, budget, objective="trace").guarantee == trace
    assert select_tiles(agents, budget, objective="lambda_min").guarantee is None


# --- the linear programs and the criteria ---


def test_sorting_solves_the_same_linear_program_as_simplex():
    rng = np.random.default_rng(29)
    for _ in range(20):
        n, agents = 25, 3
        worth, size = rng.exponential(size=n), rng.integers(1, 20, n).astype(np.float64)
        agent = rng.integers(0, agents, n)
        agent_room, room = rng.integers(10, 60, agents).astype(np.float64), 90.0
        x = _by_sorting(worth, size, agent, agent_room, room)
        usage = np.vstack([np.where(agent == a, size, 0.0) for a in range(agents)] + [size])
        oracle = linprog(-worth, A_ub=usage, b_ub=[*agent_room, room], bounds=(0, 1))
        assert worth @ x == pytest.approx(-oracle.fun)
        assert (usage @ x <= np.array([*agent_room, room]) + 1e-9).all()


def test_dual_prices_bound_the_linear_program_with_tiles_and_bytes():
    rng = np.random.default_rng(30)
    for _ in range(10):
        problem = random_problem(
            rng, "few rows", 20, costs=True, tiles=6.0, agent_tiles=3.0, size=600.0, agent_size=300.0
        )
        worth = rng.exponential(size=20) * 1e9
        x, bound = _by_simplex(problem, worth)
        assert worth @ x == pytest.approx(bound, rel=1e-6)
        assert bound >= worth @ x * (1.0 - 1e-9)


@pytest.mark.parametrize("criterion", [*OBJECTIVES.values(), KieferMean(1.0), KieferMean(7.0)])
def test_prices_are_supergradients(criterion):
    rng = np.random.default_rng(31)
    for _ in range(50):
        M, N = (random_tile(rng, "full rank") + np.eye(6) for _ in range(2))
        linear = criterion.value(M) + np.sum(criterion.price(M) * (N - M))
        assert criterion.value(N) <= linear + 1e-9 * abs(linear)
        gains = criterion.gains(M, N[None])
        assert gains[0] == pytest.approx(criterion.value(M + N) - criterion.value(M), rel=1e-9)


def test_log_det_of_an_indefinite_matrix_is_minus_infinity():
    assert LogDet().value(diagonal(-1, -1, 1, 1, 1, 1)) == -np.inf
    assert LogDet().value(diagonal(2, 1, 1, 1, 1, 1)) == pytest.approx(math.log(2.0))


# --- select_tiles ---


def agents_of(
    rng: np.random.Generator, *, count: int = 3, tiles: int = 6, costs=(100,), noise: float = 0.0, signal=1.0
) -> list[TileInformation]:
    agents = []
    for a in range(count):
        blocks = signal * np.array([random_tile(rng, "full rank") for _ in range(tiles)])
        select, report = (
            blocks + noise * (draw + draw.swapaxes(1, 2)) for draw in rng.normal(size=(2, tiles, 6, 6))
        )
        agents.append(agent_of(select, report, name=f"robot{a}", cost=np.resize(costs, tiles)))
    return agents


def agent_of(select, report=None, /, *, name="robot0", cost=None, **fields) -> TileInformation:
    select = np.asarray(select)
    n = len(select)
    values = {
        "agent": name,
        "tiles": np.column_stack([16 * np.arange(n), np.zeros(n, int), np.full((n, 2), 16)]),
        "select": select,
        "report": select if report is None else report,
        "cost_bytes": np.full(n, 100) if cost is None else cost,
        "linearisation": about(variable="body", length_scale=1.0),
    }
    return TileInformation(**(values | fields))


def test_a_selection_reports_its_tiles_values_bound_and_baselines():
    agents = agents_of(np.random.default_rng(32), noise=0.5, costs=(90, 120))
    selection = select_tiles(agents, Budget(tiles=5, tiles_per_agent=2))
    chosen = [next(a for a in agents if a.agent == c.agent) for c in selection.chosen]
    F = np.eye(6) + sum(a.report[c.tile] for a, c in zip(chosen, selection.chosen, strict=True))
    assert selection.value_heldout == pytest.approx(np.linalg.slogdet(F).logabsdet)
    assert selection.total_bytes == sum(
        a.cost_bytes[c.tile] for a, c in zip(chosen, selection.chosen, strict=True)
    )
    assert len(selection.chosen) == 5
    assert max(sum(c.agent == a.agent for c in selection.chosen) for a in agents) == 2
    assert selection.value_empty == 0.0
    assert selection.value <= selection.upper_bound
    assert 0.95 < selection.certificate <= 1.0
    assert set(selection.baselines) == {"random", "equal_split", "top_trace"}
    assert all(base.value <= selection.upper_bound for base in selection.baselines.values())
    text = str(selection)
    assert f"{selection.value:.4g} on the half chosen by" in text
    assert f"{selection.value_heldout:.4g} held out" in text


@pytest.mark.parametrize("objective", list(OBJECTIVES))
def test_baselines_stay_within_the_budget_and_below_the_selection(objective):
    agents = agents_of(np.random.default_rng(33), count=4, tiles=12, costs=(60, 100, 140))
    for budget in (Budget(tiles=10), Budget(tiles=10, tiles_per_agent=3), Budget(bytes=1000)):
        selection = select_tiles(agents, budget, objective=objective)
        for base in selection.baselines.values():
            assert base.value <= selection.value * (1.0 + 1e-12)


def test_lazy_and_plain_selections_are_the_same():
    agents = agents_of(np.random.default_rng(34), tiles=20)
    for objective in OBJECTIVES:
        lazy, plain = (
            select_tiles(agents, Budget(tiles=7), objective=objective, lazy=x) for x in (True, False)
        )
        assert lazy.chosen == plain.chosen
        assert lazy.evaluations <= plain.evaluations


def test_a_bound_for_a_larger_budget_bounds_a_smaller_one_and_a_worse_one_changes_nothing():
    agents = agents_of(np.random.default_rng(36), tiles=8)
    smaller, larger = (select_tiles(agents, Budget(tiles=tiles)) for tiles in (3, 6))
    assert smaller.bounded(larger.upper_bound) == smaller
    tight = smaller.bounded(smaller.value)
    assert (tight.upper_bound, tight.certificate) == (smaller.value, 1.0)


def test_noise_alone_looks_informative_where_it_was_chosen_but_not_held_out():
    # No information at all: 5 of 5 independent draws must show the winner's curse and its absence.
    for seed in range(5):
        agents = agents_of(np.random.default_rng(seed), count=4, tiles=100, noise=1e-3, signal=0.0)
        selection = select_tiles(agents, Budget(tiles=40), objective="trace")
        promised = selection.value - selection.value_empty
        delivered = selection.value_heldout - selection.value_empty
        # Sum of 40 independent traces of standard deviation 2 sqrt(6) 1e-3: 4 standard deviations.
        assert abs(delivered) < 4.0 * 2.0 * math.sqrt(6.0 * 40.0) * 1e-3
        assert promised > 4.0 * abs(delivered)


def test_the_report_half_may_be_so_noisy_that_log_det_does_not_exist():
    rng = np.random.default_rng(35)
    tile = random_tile(rng, "full rank")
    selection = select_tiles([agent_of([tile], [-10.0 * tile])], Budget(tiles=1))
    assert selection.value_heldout == -np.inf
    assert selection.to_dict()["value_heldout"] == "-inf"


def test_a_budget_beyond_what_exists_chooses_everything():
    agents = agents_of(np.random.default_rng(36))
    for budget in (
        Budget(),
        Budget(tiles=10**9, tiles_per_agent=10**9, bytes=10**12, bytes_per_agent=10**12),
    ):
        for objective in OBJECTIVES:
            selection = select_tiles(agents, budget, objective=objective)
            assert len(selection.chosen) == 18
            assert selection.certificate == pytest.approx(1.0)


@pytest.mark.parametrize(
    "budget", [Budget(tiles=0), Budget(bytes=0), Budget(bytes=99), Budget(tiles_per_agent=0)]
)
def test_a_budget_too_small_for_any_tile_chooses_nothing(budget):
    for objective in OBJECTIVES:
        selection = select_tiles(agents_of(np.random.default_rng(37)), budget, objective=objective)
        assert selection.chosen == ()
        assert selection.value == selection.upper_bound == selection.value_empty
        assert selection.certificate == 1.0


def test_limits_by_name_bind_only_the_agents_named():
    agents = agents_of(np.random.default_rng(38))
    selection = select_tiles(agents, Budget(tiles_per_agent={"robot1": 2}, bytes_per_agent={"robot2": 350}))
    counts = [sum(c.agent == agent.agent for c in selection.chosen) for agent in agents]
    assert counts == [6, 2, 3]


def test_an_agent_without_tiles_is_no_obstacle():
    agents = [*agents_of(np.random.default_rng(39)), agent_of(np.zeros((0, 6, 6)), name="blind")]
    for budget in (Budget(tiles=4, tiles_per_agent=2), Budget(bytes=450, bytes_per_agent=250)):
        assert len(select_tiles(agents, budget).chosen) == 4
    assert select_tiles([agents[-1]], Budget(tiles=4)).chosen == ()


def test_a_prior_directs_the_choice_to_what_it_does_not_know():
    x, y = diagonal(5, 0, 0, 0, 0, 0), diagonal(0, 4, 0, 0, 0, 0)
    agents = [agent_of([x, y])]
    assert select_tiles(agents, Budget(tiles=1)).chosen[0].tile == 0
    prior = diagonal(1e3, 0, 1, 1, 1, 1)
    assert select_tiles(agents, Budget(tiles=1), prior=prior).chosen[0].tile == 1
    assert select_tiles(agents, Budget(tiles=1), prior=prior + np.eye(6), ridge=0.0).chosen[0].tile == 1


# --- what is refused ---


def test_correlated_noise_is_refused_with_the_reason():
    tile = np.eye(6)[None]
    agents = [agent_of(tile, name="left"), agent_of(tile, name="right", correlated_noise=True)]
    with pytest.raises(SelectionError, match=r"'right' is correlated between pixels: .* does not add"):
        select_tiles(agents, Budget(tiles=1))


def test_agents_that_do_not_belong_together_are_refused():
    tile = np.eye(6)[None]
    moved = np.eye(4)
    moved[0, 3] = 1.0
    with pytest.raises(SelectionError, match="no agents"):
        select_tiles([], Budget(tiles=1))
    with pytest.raises(SelectionError, match="'robot0' occurs twice"):
        select_tiles([agent_of(tile), agent_of(tile)], Budget(tiles=1))
    for fields, message in (
        ({"variable": "drone"}, "tiles of 'robot0' and 'robot1' about 'body' and about 'drone'"),
        ({"length_scale": 2.0}, "length scale"),
        ({"pose": moved}, "different poses"),
    ):
        with pytest.raises(FrameError, match=message):
            select_tiles([agent_of(tile), agent_of(tile, name="robot1").about(**fields)], Budget(tiles=1))


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"tiles": -1}, "tiles is negative: -1"),
        ({"bytes": -5}, "bytes is negative: -5"),
        ({"tiles_per_agent": {"robot0": -2}}, "tiles_per_agent is negative: -2"),
        ({"tiles": 2.5}, "whole number, not 2.5"),
        ({"bytes": True}, "whole number, not True"),
        ({"bytes_per_agent": "many"}, "whole number, not 'many'"),
    ],
)
def test_impossible_budgets_are_refused(limits, message):
    with pytest.raises(SelectionError, match=message):
        Budget(**limits)


def test_a_budget_for_an_unknown_agent_names_the_near_one():
    with pytest.raises(SelectionError, match="'robto0', which is no agent; did you mean 'robot0'"):
        select_tiles([agent_of(np.eye(6)[None])], Budget(tiles_per_agent={"robto0": 1}))
    with pytest.raises(SelectionError, match="the agents are robot0"):
        select_tiles([agent_of(np.eye(6)[None])], Budget(bytes_per_agent={"xyz": 1}))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"select": np.eye(6)}, r"select must have shape \(1, 6, 6\)"),
        ({"report": np.full((1, 6, 6), np.nan)}, "report is not finite in 1 of 1 tiles"),
        ({"select": np.triu(np.ones((6, 6)))[None]}, "not symmetric"),
        ({"select": [["a"]]}, "no array of numbers"),
        ({"cost_bytes": [0]}, "positive numbers"),
        ({"cost_bytes": [1, 2]}, "positive numbers"),
        ({"cost_bytes": [10.5]}, "whole numbers"),
        ({"tiles": [[0, 0, 0, 16]]}, "no width"),
        ({"tiles": [[0, 0]]}, "shape"),
        ({"tiles": [[0], [0, 1]]}, "no array"),
    ],
)
def test_malformed_tiles_are_refused(fields, message):
    with pytest.raises(SelectionError, match=message):
        agent_of(np.eye(6)[None], **fields)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"objective": "det"}, "unknown objective 'det'"),
        ({"ridge": -1.0}, "ridge"),
        ({"ridge": np.nan}, "ridge"),
        ({"ridge": "much"}, "ridge"),
        ({"ridge": 0.0}, "positive definite"),
        ({"ridge": 0.0, "objective": "lambda_min"}, "positive definite"),
        ({"ridge": 0.0, "prior": np.diag([1.0, 1, 1, 1, 1, 0])}, "positive definite"),
        ({"prior": np.eye(3)}, "6 x 6"),
        ({"prior": "none"}, "6 x 6"),
        ({"prior": np.triu(np.ones((6, 6)))}, "not symmetric"),
        ({"prior": -np.eye(6)}, "not positive semi-definite"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(SelectionError, match=message):
        select_tiles([agent_of(np.eye(6)[None])], Budget(tiles=1), **options)


def test_the_trace_needs_no_prior_information():
    selection = select_tiles([agent_of(np.eye(6)[None])], Budget(tiles=1), objective="trace", ridge=0.0)
    assert selection.value == pytest.approx(6.0)
    assert selection.value_empty == 0.0


def test_limits_are_in_the_agents_order():
    agents = agents_of(np.random.default_rng(40))
    limits = limits_of(Budget(tiles_per_agent={"robot2": 1, "robot0": 3}, bytes=7), agents)
    assert limits.agent_tiles.tolist() == [3.0, np.inf, 1.0]
    assert limits.bytes == 7.0
    assert limits.tiles == np.inf

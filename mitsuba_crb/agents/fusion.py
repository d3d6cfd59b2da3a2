"""Agents that observe one pose through known transforms: cameras on a rig, robots in formation.

An agent's twist follows from the common body's by ξ_agent = A ξ_common, A = Ad(agent_from_common), so that

    F_joint = Σ_a A_aᵀ F_a A_a

in the body's own frame (right perturbation of world_from_common, called "camera" like every such frame,
`se3`). With g = common_from_agent, A is the Ad(g⁻¹) of the paper. Between agents in one *world* frame A is
the identity, but far from the world's origin that sum cancels, which is why the body frame is used here.

A nuisance η that the agents share (`shared_nuisance`) couples their measurements and leaves by Schur
complement:

    F_joint − X (K + Σ N_a)⁻¹ Xᵀ,    X = Σ A_aᵀ X_a.

Independent poses are `pose_graph`'s, information of unknown correlation `covariance_intersection`'s, messages
`information_filter`'s.

Reference: Muthukkumar, "Multi-Agent Pose Uncertainty: A Differentiable Rendering Cramér–Rao Bound", ICCV
workshop 2025, section 3.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import add

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from ..bound.cramer_rao import PoseBound, cramer_rao_bound
from ..errors import FrameError, FusionError
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.significance import identified, refuse_negative
from ..noise.covariance import roots
from ..se3 import Array
from .shared_nuisance import SharedNuisance

# Poses in scene files are float32 or text; a larger disagreement is a wrong transform.
_POSE_TOLERANCE = 1e-5
_NUISANCE_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class Agent(Record):
    """One agent, where it sits on the common body, and what it knows about its own pose."""

    name: str
    """Unique among the agents that are fused."""
    information: FisherInformation
    """About the agent's own pose, in either frame."""
    common_from_agent: Array
    """(4, 4), the agent's pose on the body: g of the paper."""

    def __post_init__(self) -> None:
        g = se3.as_pose(self.common_from_agent, f"the transform of agent {self.name!r}")
        object.__setattr__(self, "common_from_agent", g)

    @property
    def world_from_common(self) -> Array:
        """(4, 4), where the agent's own pose puts the body."""
        world: Array = self.information.pose @ se3.inverse(self.common_from_agent)
        return world


@dataclass(frozen=True, eq=False)
class AgentShare(Record):
    """What one agent brings to the joint information."""

    name: str
    """The agent's name."""
    information: FisherInformation
    """About the body's pose, in the body's frame."""
    rank: int
    """Directions that the agent sees alone."""
    share: float
    """tr(F_joint⁻¹ F_a) / r over the r directions that all together see; they add up to one, unless a shared
    nuisance takes information away."""


@dataclass(frozen=True, eq=False)
class Fusion(Record):
    """What the agents know together."""

    information: FisherInformation
    """About the body's pose, in the body's frame."""
    agents: tuple[AgentShare, ...]
    """In the order given."""

    @cached_property
    def bound(self) -> PoseBound:
        """The Cramér–Rao bound of the body's pose."""
        return cramer_rao_bound(self.information)

    def __str__(self) -> str:
        lines = [f"{a.name}: rank {a.rank}, share {a.share:.1%}" for a in self.agents]
        return "\n".join([str(self.bound), *lines])


def agents_in_world(
    informations: Mapping[str, FisherInformation], world_from_common: ArrayLike
) -> list[Agent]:
    """Agents by name whose poses in one world say where they sit on a body at `world_from_common` (4, 4)."""
    common_from_world = se3.inverse(se3.as_pose(world_from_common))
    return [Agent(name, found, common_from_world @ found.pose) for name, found in informations.items()]


def to_common(
    agent: Agent, *, variable: str, world_from_common: ArrayLike | None = None
) -> FisherInformation:
    """An agent's information about the body's pose, in the body's frame: Aᵀ F A, A = Ad(agent_from_common).

    Args:
        agent: the agent.
        variable: the body's name.
        world_from_common: the body's pose, 4 x 4, if it is known better than by this agent's own.
    """
    pose = agent.world_from_common if world_from_common is None else world_from_common
    A = se3.adjoint(se3.inverse(agent.common_from_agent))
    return agent.information.to_frame("camera").transform(A, variable=variable, frame="camera", pose=pose)


def fuse(agents: Sequence[Agent], *, variable: str = "body", shared: SharedNuisance | None = None) -> Fusion:
    """The joint information of agents about one pose; their order changes nothing.

    Args:
        agents: with independent measurements.
        variable: the body's name.
        shared: parameters that the agents' measurements have in common, coupled by the agents' variables.

    Raises:
        FusionError: no agents, two of one name, information that is negative beyond noise, or a nuisance
            coupled with a variable that no agent has.
        FrameError: the agents' poses and transforms put the body in different places.
    """
    _check_names(agents)
    ordered = sorted(agents, key=lambda agent: agent.name)
    world_from_common = se3.as_pose(ordered[0].world_from_common)
    for agent in ordered:
        reach = float(max(np.abs(agent.information.pose).max(), np.abs(agent.common_from_agent).max()))
        refuse_two_places(
            agent.name, agent.world_from_common, ordered[0].name, world_from_common, reach=reach
        )
        refuse_negative(agent.information, agent.name)
    common = {a.name: to_common(a, variable=variable, world_from_common=world_from_common) for a in ordered}
    joint = reduce(add, common.values())
    if shared is not None:
        joint = replace(joint, matrix=joint.matrix - _lost(shared, ordered), plain_matrix=None)
    found = identified(joint)
    inverse_root = joint.scale[:, None] * found.seen / np.sqrt(found.eigenvalues[: found.rank])
    shares = tuple(
        AgentShare(
            name=agent.name,
            information=common[agent.name],
            rank=identified(agent.information).rank,
            share=float(np.trace(inverse_root.T @ common[agent.name].matrix @ inverse_root))
            / max(found.rank, 1),
        )
        for agent in agents
    )
    return Fusion(joint, shares)


def _lost(nuisance: SharedNuisance, agents: Sequence[Agent]) -> Array:
    """(6, 6), X (K + Σ N)⁺ Xᵀ in the body's frame."""
    X = np.zeros((6, nuisance.size))
    missing = set(nuisance.cross)
    for agent in agents:
        coupling = nuisance.cross.get(agent.information.variable)
        if coupling is not None:
            X += se3.adjoint(se3.inverse(agent.common_from_agent)).T @ coupling
            missing.discard(agent.information.variable)
    if missing:
        raise FusionError(f"{nuisance.name!r} is coupled with {min(missing)!r}, which no agent observes")
    # Where nothing is measured of η, X is zero.
    root = X @ roots(nuisance.total, _NUISANCE_TOLERANCE)[1]
    lost: Array = root @ root.T
    return lost


def _check_names(agents: Sequence[Agent]) -> None:
    if not agents:
        raise FusionError("there are no agents to fuse")
    names = [agent.name for agent in agents]
    twice = sorted({name for name in names if names.count(name) > 1}) if len(set(names)) < len(names) else []
    if twice:
        raise FusionError(f"agent names must differ, but {', '.join(map(repr, twice))} occurs twice")


def refuse_two_places(
    name: str, world_from_common: Array, first: str, expected: Array, *, reach: float = 1.0
) -> None:
    """Refuse an agent whose pose and transform put the body elsewhere than another agent's.

    Args:
        name: the agent.
        world_from_common: (4, 4), where it puts the body.
        first: the other agent.
        expected: (4, 4), where that one puts it.
        reach: a distance that entered the computation, which float32 rounds [scene unit].

    Raises:
        FrameError: the two differ by more than rounding.
    """
    difference = se3.inverse(expected) @ world_from_common
    distance = float(np.linalg.norm(difference[:3, 3]))
    angle = float(np.linalg.norm(difference[:3, :3] - np.eye(3))) / np.sqrt(2.0)
    reach = max(1.0, reach, float(np.abs(world_from_common).max()))
    if distance > _POSE_TOLERANCE * reach or angle > _POSE_TOLERANCE:
        raise FrameError(
            f"the pose and the transform of agent {name!r} put the body {distance:.3g} scene units and "
            f"{np.degrees(angle):.3g} degrees from where those of {first!r} put it; is a transform inverted?"
        )

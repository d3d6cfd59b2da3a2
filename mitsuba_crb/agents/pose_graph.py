"""Several independent poses at once, tied by measurements of their relative poses: one 6A x 6A information.

With every pose's twist in its own camera frame, a measurement of a_from_b with error exp(ε) on the right sees

    ε = ξ_b − Ad(b_from_a) ξ_a,    and adds    Hᵀ Ω H,    H = [−Ad(b_from_a), 1].

Images add blocks on the diagonal, points that several cameras see (`bundle`) also blocks between poses, and
a shared nuisance (`shared_nuisance`) rows and columns of its own, which couple all that depend on it. From
the joint matrix follow, each as a `FisherInformation` with its uncertainty, so that `cramer_rao_bound` turns
them into covariances with infinities where they belong:

- the marginal of a pose, the others unknown;
- the conditional of a pose, others known exactly;
- the pose of b seen from a, whatever is unknown of both together.

Without absolute information the poses move together freely: six directions, the gauge, that only `fixed`
removes. `gauges` states what is free. Which directions count as seen is decided for all poses at once
(`joint_state`).

References: Dellaert and Kaess, "Factor Graphs for Robot Perception", 2017, chapters 2 and 6; Barfoot, "State
Estimation for Robotics", 2nd ed., section 8.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from .. import se3
from ..errors import FusionError
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.identifiability import FLOAT32_FLOOR
from ..information.linearisation import Linearisation, PixelSelection
from ..information.significance import refuse_negative, scaled_covariance
from ..noise.covariance import positive_matrix
from ..se3 import Array
from .joint_state import JointState
from .shared_nuisance import SharedNuisance

# Cosine of the angle to the unseen subspace up to which a common motion counts as free.
_FREE = 0.99
_NAMES = 4


@dataclass(frozen=True, eq=False)
class RelativePose(Record):
    """A measurement of b's pose seen from a, a_from_b exp(ε)."""

    a: str
    """The variable that it is seen from."""
    b: str
    """The variable that is seen."""
    information: Array
    """(6, 6), Ω of ε, in b's frame: exact, and singular where the measurement does not see."""

    def __post_init__(self) -> None:
        what = f"the information of the relative pose of {self.b!r} seen from {self.a!r}"
        information = positive_matrix(self.information, what, FusionError, size=6)
        object.__setattr__(self, "information", information)
        if self.a == self.b:
            raise FusionError(f"a relative pose ties two variables, not {self.a!r} to itself")


@dataclass(frozen=True, eq=False)
class JointPoseInformation(Record):
    """What one measurement tells of several poses together, such as points that they all see."""

    variables: tuple[str, ...]
    """The poses, each once."""
    matrix: Array
    """(6A, 6A), twists in each pose's own camera frame, in the order of `variables`: exact."""

    def __post_init__(self) -> None:
        if len(set(self.variables)) < len(self.variables) or not self.variables:
            raise FusionError(f"a joint information needs different variables, not {list(self.variables)}")
        what = f"the joint information of {', '.join(self.variables[:_NAMES])}"
        matrix = positive_matrix(self.matrix, what, FusionError, size=6 * len(self.variables))
        object.__setattr__(self, "matrix", matrix)


@dataclass(frozen=True)
class Gauge(Record):
    """What is free in a connected part of the graph."""

    variables: tuple[str, ...]
    """The poses of this part."""
    free: int
    """Directions, among those of all poses and nuisances, that nothing measures."""
    common: int
    """How many of them are motions of all poses together as one body."""

    def __str__(self) -> str:
        names = ", ".join(self.variables[:_NAMES]) + (", ..." if len(self.variables) > _NAMES else "")
        if self.free == 0:
            return f"{names}: anchored, nothing is free"
        motions = f", {self.common} of them motions of all together" if self.common else ""
        only = "; only relative poses are known" if self.common == 6 and len(self.variables) > 1 else ""
        return f"{names}: {self.free} directions are free{motions}{only}"


class PoseGraph:
    """Poses, each with its own information, relative measurements between them, and a nuisance they share."""

    def __init__(
        self,
        poses: Sequence[FisherInformation],
        relative: Sequence[RelativePose] = (),
        *,
        shared: SharedNuisance | None = None,
        joint: Sequence[JointPoseInformation] = (),
    ) -> None:
        """Collect what is known; nothing is decided before it is asked for.

        Args:
            poses: one information per variable, in either frame; `no_information` for a pose that has none.
            relative: any number, also several between the same two poses.
            shared: coupled with the poses by their variables.
            joint: measurements of several poses at once, independent of one another and of the rest.

        Raises:
            FusionError: no poses, two of one variable, unknown variables, or negative information.
        """
        self._poses = {pose.variable: pose.to_frame("camera") for pose in poses}
        if not poses:
            raise FusionError("there are no poses")
        if len(self._poses) < len(poses):
            names = [pose.variable for pose in poses]
            twice = next(name for name in names if names.count(name) > 1)
            raise FusionError(f"variables must differ, but {twice!r} occurs twice")
        for name, pose in self._poses.items():
            refuse_negative(pose, name)
        self._relative = tuple(relative)
        self._joint = tuple(joint)
        self._shared = shared
        self._fixed: frozenset[str] = frozenset()
        for link in self._relative:
            self._known(link.a, link.b)
        for tie in self._joint:
            self._known(*tie.variables)
        self._known(*(shared.cross if shared else ()))

    @property
    def variables(self) -> tuple[str, ...]:
        """The poses that are not fixed, in the matrix' order."""
        return tuple(name for name in self._poses if name not in self._fixed)

    @cached_property
    def matrix(self) -> sp.csc_array:
        """(6A + m, 6A + m), twists in each pose's own camera frame, then the nuisance's parameters."""
        size = 6 * len(self._poses) + (self._shared.size if self._shared else 0)
        place = {name: 6 * k for k, name in enumerate(self._poses)}
        blocks = [(place[name], place[name], pose.matrix) for name, pose in self._poses.items()]
        for link in self._relative:
            a, b = place[link.a], place[link.b]
            H = -self._adjoint(link.a, link.b)
            cross = H.T @ link.information
            blocks += [(a, a, cross @ H), (a, b, cross), (b, a, cross.T), (b, b, link.information)]
        for tie in self._joint:
            count = len(tie.variables)
            split = tie.matrix.reshape(count, 6, count, 6)
            ends = [(i, place[name]) for i, name in enumerate(tie.variables)]
            blocks += [(a, b, split[i, :, j]) for i, a in ends for j, b in ends]
        if self._shared is not None:
            end = 6 * len(self._poses)
            blocks.append((end, end, self._shared.total))
            for name, X in self._shared.cross.items():
                blocks += [(place[name], end, X), (end, place[name], X.T)]
        rows = np.concatenate([np.repeat(r + np.arange(len(B)), B.shape[1]) for r, _, B in blocks])
        columns = np.concatenate([np.tile(c + np.arange(B.shape[1]), len(B)) for _, c, B in blocks])
        entries = np.concatenate([B.ravel() for _, _, B in blocks])
        whole = sp.coo_array((entries, (rows, columns)), shape=(size, size)).tocsr()
        free = [place[name] + i for name in self.variables for i in range(6)]
        free += range(6 * len(self._poses), size)
        matrix = whole[free][:, free].tocsc()
        for stored in (matrix.data, matrix.indices, matrix.indptr):
            stored.flags.writeable = False
        return matrix

    @cached_property
    def gauges(self) -> tuple[Gauge, ...]:
        """What is free in each connected part, in the order of its first pose."""
        return tuple(self._gauge(part) for part in self._parts)

    def marginal(self, variable: str) -> FisherInformation:
        """What all measurements together tell of a pose, the others (and the nuisance) unknown."""
        self._free(variable)
        part = self._part_of(variable)
        pose = self._poses[variable]
        return self._projected(part, part.selector(variable), pose, variable, pose.pose)

    def conditional(self, variable: str, *, given: Sequence[str] | None = None) -> FisherInformation:
        """The same if other poses were known exactly: those `given`, or all; the nuisance stays unknown."""
        others = [name for name in self.variables if name != variable] if given is None else given
        return self.fixed(*others).marginal(variable)

    def relative(self, a: str, b: str) -> FisherInformation:
        """What all measurements together tell of b's pose seen from a: the error ε of a_from_b exp(ε).

        Its pose is a_from_b, so that positions in its bound are along a's axes.
        """
        self._free(a, b)
        if a == b:
            raise FusionError(f"a relative pose needs two variables, not {a!r} twice")
        first, second = self._poses[a], self._poses[b]
        name = f"{b} seen from {a}"
        a_from_b = se3.inverse(first.pose) @ second.pose
        part = self._part_of(a, b)
        # ε in b's units from both poses' scaled twists.
        H = -self._adjoint(a, b) * first.scale / second.scale[:, None]
        return self._projected(part, part.selector(b) + part.selector(a) @ H.T, second, name, a_from_b)

    def fixed(self, *variables: str) -> PoseGraph:
        """The graph with poses known exactly: what a gauge, or a surveyed camera, means."""
        self._free(*variables)
        graph = copy(self)
        for derived in ("matrix", "gauges", "_parts"):
            graph.__dict__.pop(derived, None)
        graph._fixed = self._fixed | set(variables)
        return graph

    @cached_property
    def _parts(self) -> tuple[_Part, ...]:
        """Connected parts; what is not connected is decided and inverted on its own."""
        variables = self.variables
        owner = np.repeat(np.arange(len(variables)), 6)
        parameters = self.matrix.shape[0] - len(owner)
        owner = np.concatenate([owner, len(variables) + np.zeros(parameters, dtype=np.intp)])
        entries = self.matrix.tocoo()
        links = sp.coo_array((entries.data != 0.0, (owner[entries.row], owner[entries.col])))
        links.resize((int(owner.max(initial=-1)) + 1,) * 2)
        count, label = connected_components(links, directed=False)
        parts = [
            self._part(
                tuple(np.array(variables, dtype=object)[label[: len(variables)] == k]), label[owner] == k
            )
            for k in range(count)
        ]
        return tuple(part for part in parts if part.variables)

    def _part(self, variables: tuple[str, ...], rows: NDArray[np.bool_]) -> _Part:
        matrix = self.matrix[rows][:, rows]
        poses = [self._poses[name] for name in variables]
        scale = np.concatenate([pose.scale for pose in poses])
        diagonal = matrix.diagonal()
        typical = float(np.median(diagonal[: len(scale)] * scale**2))
        # The nuisance's parameters have units of their own: give them the poses' typical size.
        own = diagonal[len(scale) :]
        with np.errstate(divide="ignore"):
            scale = np.concatenate([scale, np.where(own > 0.0, np.sqrt(max(typical, 0.0) / own), 1.0)])
        scale[scale == 0.0] = 1.0
        unit = sp.diags_array(scale)
        noise = {6 * k: scaled_covariance(pose) for k, pose in enumerate(poses)}
        floor = np.zeros(len(scale))
        for k, pose in enumerate(poses):
            largest = np.linalg.eigvalsh(pose.scale[:, None] * pose.matrix * pose.scale)[-1]
            floor[6 * k : 6 * k + 6] = FLOAT32_FLOOR * max(float(largest), 0.0)
        return _Part(variables, JointState((unit @ matrix @ unit).tocsc(), noise, floor), rows)

    def _part_of(self, *variables: str) -> _Part:
        """The part that holds these poses; several parts are taken together."""
        parts = [part for part in self._parts if not set(part.variables).isdisjoint(variables)]
        if len(parts) == 1:
            return parts[0]
        rows = np.logical_or.reduce([part.rows for part in parts])
        held = set().union(*(part.variables for part in parts))
        return self._part(tuple(name for name in self.variables if name in held), rows)

    def _projected(
        self, part: _Part, functionals: Array, like: FisherInformation, variable: str, pose: Array
    ) -> FisherInformation:
        """Information about scaled functionals in the units of `like`."""
        projection = part.state.project(functionals)
        unit = 1.0 / like.scale
        selections = [self._poses[name].selection for name in part.variables]
        return FisherInformation(
            matrix=unit[:, None] * projection.matrix * unit,
            covariance_of_entries=part.state.covariance_of_entries(projection.response * unit),
            linearisation=Linearisation(
                variable=variable,
                frame="camera",
                pose=pose,
                length_scale=like.length_scale,
                selection=PixelSelection(
                    "all" if all(s.kind == "all" for s in selections) else "only",
                    sum(s.total for s in selections),
                    sum(s.selected for s in selections),
                    f"those of {len(selections)} poses",
                ),
            ),
        )

    def _gauge(self, part: _Part) -> Gauge:
        free = part.state.unseen
        anchor = se3.inverse(self._poses[part.variables[0]].pose)
        common = np.zeros((len(free), 6))
        for k, name in enumerate(part.variables):
            pose = self._poses[name]
            # Scaled twists when everything moves with the first pose as one body.
            motion = se3.adjoint(se3.inverse(anchor @ pose.pose))
            common[6 * k : 6 * k + 6] = motion / pose.scale[:, None]
        cosines = np.linalg.svd(free.T @ np.linalg.qr(common)[0], compute_uv=False)
        return Gauge(part.variables, free.shape[1], int(np.count_nonzero(cosines > _FREE)))

    def _adjoint(self, a: str, b: str) -> Array:
        """Ad(b_from_a)."""
        return se3.adjoint(se3.inverse(self._poses[b].pose) @ self._poses[a].pose)

    def _known(self, *variables: str) -> None:
        unknown = [name for name in variables if name not in self._poses]
        if unknown:
            near = get_close_matches(unknown[0], self._poses, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(list(self._poses)[:8])}"
            raise FusionError(f"no pose is called {unknown[0]!r}; {hint}")

    def _free(self, *variables: str) -> None:
        self._known(*variables)
        fixed = [name for name in variables if name in self._fixed]
        if fixed:
            raise FusionError(f"the pose {fixed[0]!r} is fixed, so that there is nothing to know of it")


@dataclass(frozen=True, eq=False)
class _Part:
    """A connected part of the graph."""

    variables: tuple[str, ...]
    state: JointState
    rows: NDArray[np.bool_]
    """Which rows of the graph's matrix."""

    def selector(self, variable: str) -> Array:
        """(n, 6), the columns that pick a pose's twist."""
        columns = np.zeros((len(self.state.unseen), 6))
        row = 6 * self.variables.index(variable)
        columns[row : row + 6] = np.eye(6)
        return columns

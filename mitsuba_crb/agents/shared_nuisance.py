"""A nuisance that several agents share: what they get wrong together does not average out.

A common light, a common map error: m parameters η that all measurements depend on. An agent's measurement
of its pose and of η has the information [[F, X], [Xᵀ, N]] of (ξ, η), with ξ the agent's twist in its camera
frame. F, with its uncertainty, is the agent's `FisherInformation`; X, N and what is known of η beforehand
are taken as exact.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from ..errors import FusionError
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.significance import seen_root
from ..noise.covariance import positive_matrix
from ..se3 import Array


@dataclass(frozen=True, eq=False)
class SharedNuisance(Record):
    """Parameters that several agents' measurements depend on."""

    name: str
    """What it is, for messages to the user."""
    known: Array
    """(m, m), information about η known beforehand; zeros where nothing is."""
    cross: Mapping[str, Array]
    """X by the agents' variables: (6, m), camera frame. Agents that are not listed do not depend on η."""
    own: Mapping[str, Array]
    """N by the agents' variables: (m, m)."""

    def __post_init__(self) -> None:
        known = np.atleast_2d(np.array(self.known, dtype=np.float64))
        m = len(known)
        if self.cross.keys() != self.own.keys():
            raise FusionError(f"{self.name!r}: `cross` and `own` must list the same variables")
        cross, own = {}, {}
        for variable in self.cross:
            X = np.array(self.cross[variable], dtype=np.float64)
            if X.shape != (6, m) or not np.isfinite(X).all():
                raise FusionError(
                    f"{self.name!r}: the coupling with {variable!r} must be finite, of shape (6, {m}), "
                    f"not {X.shape}"
                )
            cross[variable] = X
            what = f"{self.name!r}: what {variable!r} measures of it"
            own[variable] = positive_matrix(self.own[variable], what, FusionError, size=m)
        known = positive_matrix(known, f"what is known of {self.name!r}", FusionError, size=m)
        for name, value in (("known", known), ("cross", cross), ("own", own)):
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """How many parameters."""
        return len(self.known)

    @property
    def total(self) -> Array:
        """(m, m), known + Σ N: the information about η if all poses were known."""
        return np.asarray(self.known + sum(self.own.values()), dtype=np.float64)


def map_error(
    name: str, informations: Iterable[FisherInformation], known: ArrayLike, *, world_from_map: ArrayLike
) -> SharedNuisance:
    """The error of a map that all these cameras are localised in: the scene is off by world_from_map exp(η).

    A camera sees its pose in the map only: its measurement depends on ξ − Ad(camera_from_map) η. The seen
    part of its information counts.

    Args:
        name: of the map.
        informations: of the cameras, as if the map were exact.
        known: (6, 6), information about η: how well the map was surveyed.
        world_from_map: where η's axes are, 4 x 4; best amid the cameras.
    """
    pose = se3.as_pose(world_from_map)
    cross, own = {}, {}
    for information in informations:
        root = seen_root(information)
        sensitivity = -se3.adjoint(se3.inverse(information.pose) @ pose).T @ root
        cross[information.variable] = root @ sensitivity.T
        own[information.variable] = sensitivity @ sensitivity.T
    return SharedNuisance(name, np.asarray(known, dtype=np.float64), cross, own)

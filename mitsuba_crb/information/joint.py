"""Information of a pose together with nuisance parameters, and what is left of it when those are unknown.

With F = [[A, B], [Bᵀ, D]] the information of (ξ, η), a known η leaves A, and an unknown one

    A − B D⁻¹ Bᵀ = Gᵀ F G,   G = [1; −D⁻¹ Bᵀ],

the least of GᵀFG over all G with 1 on top. So noise in G counts in second order only, δ(GᵀFG) = Gᵀ δF G,
which gives the covariance of the entries. Columns leave one after the other, in their order, so that each can
only take information away; one that the image does not see, or cannot tell from those before it, has no
coupling left and takes none. Neither does one that noise hides (`unresolved`): what is left is then the bound
of a pose with that one known, a lower limit of the bound that was asked for.

A nuisance with a value of its own in every tile of the image ("gain:32") is in that tile's information only,
and leaves it tile by tile: Gᵀ F_tile G is the information of the tile's columns J G. Memory does not grow
with the number of tiles. What it takes of a tile, B D⁻¹ Bᵀ, is not linear in the tile's pixels, so that a
random subset of them does not estimate it, and is refused; a subset that is itself the measurement is not.

Source: Kay, "Fundamentals of Statistical Signal Processing", vol. I, 1993, section 3.7; van Trees 1968.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from dataclasses import replace as dataclass_replace
from itertools import chain, combinations
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FrameError, NuisanceError, OptionError, PixelsError
from ..noise import CoupledNoise, NoiseModel
from ..se3 import Array
from .accumulate import InformationAccumulator, Sums
from .block_variance import BlockProducts
from .blocks import BLOCK
from .fisher import FisherInformation
from .identifiability import FLOAT32_FLOOR
from .image_information import as_noise_model, sum_image
from .image_jacobian import ImageJacobian
from .linearisation import Linearisation, Linearised
from .symmetric import pack

Columns = list[int]
Directions = dict[int, Array]
"""What is left of columns, each a vector (P,), by the column's number."""

RESOLVED = 5.0
"""Standard errors of a column's information above which it counts; below, 1/D would be mostly noise."""


@dataclass(frozen=True, eq=False)
class JointInformation(Linearised):
    """Fisher information of a pose and of nuisance parameters, in the camera frame.

    `marginalize` and `fix` say what is not known and what is; `restore` takes that back, and nothing is lost.
    """

    sums: Mapping[frozenset[str], Sums]
    """Information of (ξ, η) by the set of nuisances without columns that are unknown, the others known;
    without such the empty set's alone."""
    parameters: tuple[str, ...]
    """Names of η's entries in the order of their columns; a nuisance of several columns repeats its name."""
    per_tile: tuple[str, ...]
    """Names of the nuisances without columns: those with a value in every tile, and a map's (`without`)."""
    treatment: Mapping[str, Literal["marginalized", "fixed"]] = field(default_factory=dict)
    """What was decided of which nuisance."""

    def __post_init__(self) -> None:
        if self.frame != "camera":
            raise FrameError(
                "a joint information is in the camera frame; call to_frame on the Jacobian first"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """All nuisances, each once."""
        return tuple(dict.fromkeys((*self.parameters, *self.per_tile)))

    @property
    def matrix(self) -> Array:
        """(6 + m, 6 + m), of (ξ, η), ξ first, per-tile nuisances known."""
        return self.sums[frozenset()].matrix

    @property
    def covariance_of_entries(self) -> Array:
        """(E, E), of `matrix`'s upper triangle in `numpy.triu_indices(6 + m)` order."""
        return self.sums[frozenset()].covariance_of_entries

    def marginalize(self, *names: str) -> JointInformation:
        """With these nuisances unknown; without names, all that nothing was decided of.

        Raises:
            NuisanceError: there is none of that name.
        """
        return self._treat(names, "marginalized")

    def fix(self, *names: str) -> JointInformation:
        """With these nuisances known; without names, all that nothing was decided of.

        Raises:
            NuisanceError: there is none of that name.
        """
        return self._treat(names, "fixed")

    def without(self, name: str, lost: Array, error: float) -> JointInformation:
        """With one nuisance, not knowing which takes (6, 6) `lost` of a pose without others.

        Args:
            error: standard error of the entries over √(lost_ii lost_jj).
        """
        sums, scale = self.sums[frozenset()], np.sqrt(np.diagonal(lost))
        own = np.diag(np.square(error * pack(np.outer(scale, scale))))
        entries = sums.covariance_of_entries + own
        left = Sums(sums.matrix - lost, entries, sums.plain_matrix - lost, sums.bias)
        return dataclass_replace(self, sums={**self.sums, frozenset([name]): left}, per_tile=(name,))

    def restore(self, *names: str) -> JointInformation:
        """With nothing decided of these nuisances; without names, of any."""
        self._check(names)
        kept = {name: how for name, how in self.treatment.items() if names and name not in names}
        return dataclass_replace(self, treatment=kept)

    @property
    def information(self) -> FisherInformation:
        """Of the pose alone.

        Raises:
            NuisanceError: nothing was decided of some nuisance.
        """
        return self._left.information(self.linearisation)

    @property
    def bias(self) -> Array:
        """(6, 6), what `information` may be wrong by, see `Sums.bias`; errors as there."""
        return self._left.bias

    @property
    def _left(self) -> Sums:
        undecided = [name for name in self.names if name not in self.treatment]
        if undecided:
            raise NuisanceError(f"say of {', '.join(undecided)} whether to marginalize() or to fix() it")
        return self._unknown_sums.transform(self.elimination)

    @property
    def elimination(self) -> Array:
        """(6 + m, 6) G, see above, of what is unknown."""
        return self._elimination[0]

    @functools.cached_property
    def _elimination(self) -> tuple[Array, Directions]:
        unknown = [6 + k for k, name in enumerate(self.parameters) if name in self._unknown]
        return _eliminate(self._unknown_sums, unknown)

    @property
    def _unknown(self) -> list[str]:
        return [name for name in self.names if self.treatment.get(name) == "marginalized"]

    @property
    def _unknown_sums(self) -> Sums:
        return self.sums[frozenset(self._unknown) & frozenset(self.per_tile)]

    @property
    def unseen(self) -> tuple[str, ...]:
        """Nuisances of the whole image that it certainly does not see, even with everything else known."""
        sums, one = self.sums[frozenset()], np.eye(6 + len(self.parameters))
        told = {
            name
            for k, name in enumerate(self.parameters, start=6)
            if _seen(sums, one[k], k) or _hidden(sums, one[k], k)
        }
        return tuple(name for name in dict.fromkeys(self.parameters) if name not in told)

    @property
    def unresolved(self) -> tuple[str, ...]:
        """Unknown nuisances of the whole image that noise hides: the information has them as known."""
        hidden = {self.parameters[column - 6] for column in self._elimination[1]}
        return tuple(name for name in dict.fromkeys(self.parameters) if name in hidden)

    @property
    def blurred(self) -> tuple[Array, Array]:
        """Of `unresolved` columns what is left, b (h, 6 + m), and what bᵀ F b must exceed (h,)."""
        sums = self._unknown_sums
        found = list(self._elimination[1].values())
        least = [_noise(sums.transform(b[:, None])) for b in found]
        return np.reshape(found, (-1, len(sums.matrix))), np.array(least, dtype=np.float64)

    def _treat(self, names: tuple[str, ...], how: Literal["marginalized", "fixed"]) -> JointInformation:
        self._check(names)
        chosen = names or [name for name in self.names if name not in self.treatment]
        if not chosen:
            return self
        return dataclass_replace(self, treatment={**self.treatment, **dict.fromkeys(chosen, how)})

    def _check(self, names: tuple[str, ...]) -> None:
        unknown = [name for name in names if name not in self.names]
        if unknown:
            known = ", ".join(self.names) or "none"
            raise NuisanceError(f"this information has no nuisance {', '.join(unknown)}; it has: {known}")


class JointAccumulator:
    """Streams the joint information of an image, as `InformationAccumulator` does that of a pose.

    All pixels of a nuisance's tile must come in the same call.
    """

    def __init__(
        self,
        parameters: tuple[str, ...],
        *,
        batches: int,
        block: int = 1,
        sampled: bool = False,
        coupled: bool = False,
    ) -> None:
        """Start from nothing.

        Args:
            parameters: names of the nuisances, in the order of their columns after the twist's six.
            batches, block, sampled, coupled: see `InformationAccumulator`.

        Raises:
            NuisanceError: per-tile nuisances with different tiles, with tiles that are no multiple of
                `BLOCK`, or with noise that couples tiles.
            OptionError: per-tile nuisances and a random subset.
        """
        self._batches, self._block = batches, block
        self._parameters = parameters
        self._side = tile_side(parameters, sampled=sampled)
        if coupled and self._side is not None:
            raise NuisanceError(
                "a nuisance per tile needs noise of independent pixels: correlated noise couples the tiles"
            )
        self._local = {
            name: [6 + k for k, parameter in enumerate(parameters) if parameter == name]
            for name in dict.fromkeys(parameters)
            if _side_of(name) is not None
        }
        count = 6 + len(parameters) - sum(map(len, self._local.values()))
        self.kept = BlockProducts(batches, count)
        """What each unit contributes, with all per-tile nuisances unknown."""
        subsets = chain.from_iterable(combinations(self._local, r) for r in range(len(self._local) + 1))
        self._parts = {
            frozenset(subset): InformationAccumulator(
                batches=batches,
                block=block,
                sampled=sampled,
                columns=count,
                coupled=coupled,
                kept=self.kept if len(subset) == len(self._local) else None,
            )
            for subset in subsets
        }
        self._tiles: set[int] = set()

    def add(
        self,
        batch_values: ArrayLike,
        weights: ArrayLike,
        pixels: ArrayLike,
        bias: NDArray[np.float64] | None = None,
        weight_bias: NDArray[np.float64] | None = None,
    ) -> None:
        """Add some pixels; arguments and errors as `InformationAccumulator.add`.

        Raises:
            PixelsError: a tile of a per-tile nuisance came in two calls.
        """
        values, positions = np.asarray(batch_values, dtype=np.float64), np.asarray(pixels)
        if self._side is None:
            self._parts[frozenset()].add(values, weights, positions, bias, weight_bias)
            return
        precision = np.asarray(weights, dtype=np.float64)
        x, y = (positions.astype(np.int64) // self._side).T
        tile = y << 32 | x
        for number in np.unique(tile):
            if int(number) in self._tiles:
                raise PixelsError(
                    f"a nuisance's {self._side} x {self._side} tile came in two calls; use tiles with sides "
                    f"that are multiples of {self._side}"
                )
            self._tiles.add(int(number))
            self._add_tile(values, precision, positions, bias, weight_bias, np.flatnonzero(tile == number))

    def add_coupled(
        self,
        batch_values: ArrayLike,
        noise: CoupledNoise,
        pixels: ArrayLike,
        bias: NDArray[np.float64] | None = None,
    ) -> None:
        """Add all pixels of an image whose noise is correlated; see `InformationAccumulator.add_coupled`."""
        self._parts[frozenset()].add_coupled(batch_values, noise, pixels, bias)

    def information(self, linearisation: Linearisation) -> JointInformation:
        """The joint information of everything added so far, with nothing decided of any nuisance.

        Args:
            linearisation: what it is about, in the camera frame.

        Raises:
            FrameError: it is in another frame.
            PixelsError: as `InformationAccumulator.information`.
        """
        return JointInformation(
            sums={subset: part.sums(linearisation.selection) for subset, part in self._parts.items()},
            parameters=tuple(name for name in self._parameters if name not in self._local),
            per_tile=tuple(self._local),
            linearisation=linearisation,
        )

    def _add_tile(
        self,
        values: Array,
        weights: Array,
        pixels: NDArray[Any],
        bias: Array | None,
        weight_bias: Array | None,
        index: NDArray[np.intp],
    ) -> None:
        values, weights, pixels = values[:, index], weights[index], pixels[index]
        bias, weight_bias = (None if each is None else each[index] for each in (bias, weight_bias))
        own = InformationAccumulator(batches=self._batches, block=self._block, columns=values.shape[-1])
        own.add(values, weights, pixels)
        sums = own.added
        others = [c for c in range(values.shape[-1]) if not any(c in local for local in self._local.values())]
        for subset, part in self._parts.items():
            unknown = [c for name in self._local if name in subset for c in self._local[name]]
            G, _ = _eliminate(sums, unknown, others)
            part.add(values @ G, weights, pixels, bias, weight_bias)


def joint_information(
    jacobian: ImageJacobian, noise: NoiseModel, mean: ArrayLike | None = None
) -> JointInformation:
    """The Fisher information of the pose and of the Jacobian's nuisance parameters, without noise bias.

    Args:
        jacobian: the image's derivative, nuisance columns included.
        noise: noise model of the measured image.
        mean: see `information.sum_image`.

    Raises:
        NoiseError: the noise model does not fit the image.
        RadianceError: the Jacobian is not finite somewhere.
    """
    camera = jacobian.to_frame("camera")
    accumulator = JointAccumulator(
        camera.parameters,
        batches=len(camera.batch_values),
        block=camera.block,
        sampled=camera.selection.kind == "random",
        coupled=as_noise_model(noise).couples_pixels,
    )
    sum_image(accumulator, camera, noise, mean)
    return accumulator.information(camera.linearisation)


def tile_side(names: tuple[str, ...], *, sampled: bool) -> int | None:
    """Side [pixel] of the tiles that the names' per-tile nuisances ("gain:32") share; None if there is none.

    Args:
        names: of all nuisances.
        sampled: a random subset of the pixels stands for the whole image.

    Raises:
        NuisanceError: they differ, or are no positive multiple of `BLOCK`.
        OptionError: there are some, and the pixels are sampled.
    """
    sides = {side for side in map(_side_of, names) if side is not None}
    if len(sides) > 1:
        raise NuisanceError(
            f"all nuisances per tile must have the same tiles, not {', '.join(map(str, sorted(sides)))}"
        )
    for side in sides:
        if side <= 0 or side % BLOCK:
            raise NuisanceError(f"the side of a nuisance's tiles must be a multiple of {BLOCK}, not {side}")
    if sides and sampled:
        local = ", ".join(dict.fromkeys(name for name in names if _side_of(name) is not None))
        raise OptionError(
            f"{local} with random:f pixels: a random subset of a tile does not tell without bias what a "
            "nuisance costs there; measure all pixels, a mask or gradient:f, or take one for the whole image"
        )
    return next(iter(sides), None)


def _side_of(name: str) -> int | None:
    found = re.fullmatch(r".+:(\d+)", name)
    return int(found[1]) if found else None


def _eliminate(sums: Sums, unknown: Columns, kept: Columns | None = None) -> tuple[Array, Directions]:
    """G (P, len(kept)) that takes unknown columns, one by one, out of an information; what noise hides.

    Args:
        sums: of all P columns.
        unknown: columns of parameters that are not known.
        kept: columns that stay, the twist's six by default; all others are known.
    """
    left = [*(range(6) if kept is None else kept), *unknown]
    G = np.eye(len(sums.matrix))[:, left]
    hidden: Directions = {}
    for column in unknown:
        own = left.index(column)
        row = G[:, own] @ sums.matrix @ G
        step = np.delete(np.eye(len(left)), own, axis=1)
        if _seen(sums, G[:, own], column):
            step[own] = -np.delete(row, own) / row[own]
        elif _hidden(sums, G[:, own], column):
            hidden[column] = G[:, own]
        G = G @ step
        left.remove(column)
    return G, hidden


def _seen(sums: Sums, direction: Array, column: int) -> bool:
    """Whether the information along a direction (P,), what is left of a column, exceeds noise."""
    own = sums.transform(direction[:, None])
    return bool(own.matrix[0, 0] > _noise(own) + _floor(sums, column))


def _hidden(sums: Sums, direction: Array, column: int) -> bool:
    """Whether noise could hide information along a direction that is not seen."""
    return _noise(sums.transform(direction[:, None])) > _floor(sums, column)


def _noise(own: Sums) -> float:
    return RESOLVED * float(np.sqrt(max(float(own.covariance_of_entries[0, 0]), 0.0)))


def _floor(sums: Sums, column: int) -> float:
    return FLOAT32_FLOOR * float(sums.plain_matrix[column, column])

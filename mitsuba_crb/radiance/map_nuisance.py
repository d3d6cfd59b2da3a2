"""What not knowing a map exactly costs: every splat's colour, or every opacity, is one more unknown.

With J = dI/dξ, S = dI/dθ of all splats' unknowns θ, W the image's weights (1 / σ²) and D the precision with
which the map is known beforehand, the pose's information after θ has been marginalised is

    F = JᵀWJ − JᵀWS (SᵀWS + D)⁻¹ SᵀWJ.

S is sparse, for a pixel sees few splats, and the inverse is never formed: six systems are solved by conjugate
gradients, whose quadratic form grows towards what is lost, so that stopping early makes F too large, never
too small. D is usually FisherRF's diagonal, `map_information` summed over the views that the map was trained
on. With SᵀWS replaced by its own diagonal what is lost is too much where splats overlap: it may exceed all
there is.

Reference: Jiang, Lei and Daniilidis 2024, FisherRF.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, vstack

from ..camera import Camera
from ..errors import FieldError
from ..render.arrays import upload
from .field import Floats, Pixels
from .gaussians import Gaussians, Lanes
from .splat_blending import blended, shares

UNKNOWNS = ("colours", "opacities")
"""Of each splat, what is not known: its colour, alike in all directions, or its opacity."""

_CHUNK = 1 << 24
"""Pairs of splat and pixel whose shares are held at once as they come from the kernel."""
_NOTHING = 1e-7
"""Shares below leave an image of float32 as it is."""
_TOLERANCE = 1e-4
"""Of the residual's norm, in the solution's own metric: what is lost is right to its square."""
_ROUNDS = 1000


@dataclass(frozen=True, eq=False)
class MapCost:
    """A pose's information with the map known, and what of it is lost where it is not."""

    known: Floats
    """(6, 6) JᵀWJ in the camera's frame."""
    lost: Floats
    """(6, 6) what not knowing the map costs."""
    lost_by_diagonal: Floats
    """(6, 6) the same with SᵀWS replaced by its diagonal."""
    unknowns: int
    """That the image sees."""
    rounds: int
    """Of conjugate gradients."""

    @property
    def information(self) -> Floats:
        """(6, 6) what is left on the pose."""
        return self.known - self.lost


class _System(NamedTuple):
    """Values of an image, and unknowns that no other system has."""

    sensitivity: csr_array
    """(values, splats) S."""
    weights: Floats
    """(values,) W."""
    place: tuple[slice, ...]
    """Where its unknowns are among all of them."""
    values: tuple[NDArray[np.int64], NDArray[np.int64]]
    """Pixel and channel of each value."""


def map_information(
    field: Gaussians, camera: Camera, pose: Floats, pixels: Pixels, weights: ArrayLike, *, unknowns: str
) -> Floats:
    """FisherRF's diagonal of one view: Σ W (dI/dθ)² of each unknown, (n, 3) for colours, (n,) for opacities.

    Args:
        weights: 1 / σ² of the values, of any shape that broadcasts to (pixels, 3) [1 / display-referred²].
        unknowns: one of `UNKNOWNS`.

    Raises:
        FieldError: the unknowns or the weights are none.
    """
    found = np.zeros((len(field.splats), 3)[: 2 if unknowns == "colours" else 1])
    for system in _systems(field, camera, pose, pixels, weights, unknowns):
        found[system.place] = system.sensitivity.power(2).T @ system.weights
    return found


def map_cost(
    field: Gaussians,
    camera: Camera,
    pose: Floats,
    pixels: Pixels,
    weights: ArrayLike,
    *,
    unknowns: str,
    prior: ArrayLike,
) -> MapCost:
    """Information on a pose where a map is known up to a Gaussian prior.

    Args:
        weights: as in `map_information`.
        unknowns: one of `UNKNOWNS`.
        prior: precision of each unknown, of any shape that broadcasts to `map_information`'s
            [1 / display-referred², or 1].

    Raises:
        FieldError: the unknowns, the weights or the prior are none.
    """
    systems = list(_systems(field, camera, pose, pixels, weights, unknowns))
    shape = (len(field.splats), 3)[: 2 if unknowns == "colours" else 1]
    try:
        precision = np.broadcast_to(np.asarray(prior, dtype=np.float64), shape)
    except (TypeError, ValueError):
        raise FieldError(f"the map's prior must fit {shape}, one precision for each unknown") from None
    if not (np.isfinite(precision).all() and (precision >= 0.0).all()):
        raise FieldError("precisions of the map's prior are finite and not negative")
    columns = field.columns(camera, pose, pixels)[1]
    known, lost, by_diagonal = np.zeros((3, 6, 6))
    count = rounds = 0
    for system in systems:
        J = columns[system.values]
        S, W, D = system.sensitivity, system.weights, precision[system.place]
        known += J.T @ (W[:, None] * J)
        right = S.T @ (W[:, None] * J)
        diagonal = S.power(2).T @ W + D
        seen = np.flatnonzero(right.any(axis=1))
        S, right, D, diagonal = S[:, seen], right[seen], D[seen], diagonal[seen]
        solution, used = _solved(S, W, D, diagonal, right)
        lost += right.T @ solution
        by_diagonal += right.T @ (right / diagonal[:, None])
        count, rounds = count + len(seen), max(rounds, used)
    return MapCost(known, 0.5 * (lost + lost.T), by_diagonal, count, rounds)


def _solved(S: csr_array, W: Floats, D: Floats, diagonal: Floats, right: Floats) -> tuple[Floats, int]:
    """(SᵀWS + D)⁻¹ of columns (k, 6), by conjugate gradients; and their rounds."""
    transposed = S.T.tocsr()
    solution, residual = np.zeros_like(right), right.copy()
    scaled = residual / diagonal[:, None]
    direction, size = scaled, np.sum(residual * scaled, axis=0)
    goal = _TOLERANCE**2 * size
    for used in range(_ROUNDS):
        if (size <= goal).all():
            return solution, used
        image = transposed @ (W[:, None] * (S @ direction)) + D[:, None] * direction
        curvature = np.sum(direction * image, axis=0)
        step = np.divide(size, curvature, out=np.zeros(6), where=curvature > 0.0)
        solution, residual = solution + step * direction, residual - step * image
        scaled = residual / diagonal[:, None]
        before, size = size, np.sum(residual * scaled, axis=0)
        direction = scaled + np.divide(size, before, out=np.zeros(6), where=before > 0.0) * direction
    return solution, _ROUNDS


def _systems(
    field: Gaussians, camera: Camera, pose: Floats, pixels: Pixels, weights: ArrayLike, unknowns: str
) -> Iterator[_System]:
    """Systems that share no unknown: of colours one per channel, of opacities one."""
    if unknowns not in UNKNOWNS:
        raise FieldError(f"of a map {' or '.join(UNKNOWNS)} are unknown, not {unknowns!r}")
    n = len(pixels)
    try:
        W = np.broadcast_to(np.asarray(weights, dtype=np.float64), (n, 3))
    except (TypeError, ValueError):
        raise FieldError(f"weights must fit ({n}, 3), one for each value of the image") from None
    if not (np.isfinite(W).all() and (W >= 0.0).all()):
        raise FieldError("weights of the image's values are finite and not negative")
    if n == 0:
        raise FieldError("no pixels are selected")
    lanes = field.lanes(camera, pose, pixels)
    parts = list(_shares(lanes, len(field.splats), unknowns == "opacities"))
    pixel = np.concatenate([rows for rows, _ in parts])
    S = [vstack([part[j] for _, part in parts], format="csr") for j in range(len(parts[0][1]))]
    ones = np.ones(len(pixel), dtype=np.int64)
    if unknowns == "colours":
        colours = np.array(lanes.drawing.records.colour).reshape(-1, 4)[: len(field.splats), :3]
        for j in range(3):
            # Those held at 0 do not follow.
            S_j = S[0].multiply(colours[None, :, j] > 0.0).tocsr()
            yield _System(S_j, W[pixel, j], (slice(None), j), (pixel, j * ones))  # type: ignore[arg-type]
        return
    opacities = field.splats.opacities
    inverse = np.divide(1.0, opacities, out=np.zeros_like(opacities), where=opacities > 0.0)
    together = vstack(S, format="csr").multiply(inverse[None]).tocsr()
    channel = np.concatenate([j * ones for j in range(3)])
    pixel = np.tile(pixel, 3)
    yield _System(together, W[pixel, channel], (slice(None),), (pixel, channel))


def _shares(
    lanes: Lanes, splats: int, opacities: bool
) -> Iterator[tuple[NDArray[np.int64], list[csr_array]]]:
    """Pixels, and what their values follow of each splat: by chunks of lanes."""
    import mitsuba as mi

    count = (lanes.last - lanes.first).astype(np.int64)
    members = np.array(lanes.drawing.members)
    # A lone pixel is there twice.
    last = len(np.unique(lanes.pixel))
    for rows in np.split(np.arange(last), np.flatnonzero(np.diff(np.cumsum(count[:last]) // _CHUNK)) + 1):
        rows = rows if len(rows) > 1 else np.repeat(rows, 2)
        ends = np.cumsum(count[rows])
        start = ends - count[rows]
        part = Lanes(lanes.drawing, lanes.pixel[rows], lanes.first[rows], lanes.last[rows], lanes.film[rows])
        arrays = part.arrays()
        total = blended(lanes.drawing, *arrays, 0, False)[0] if opacities else mi.Color3f(0.0)
        found = shares(
            lanes.drawing, *arrays, upload(mi.UInt32, start), max(int(ends[-1]), 2), total, opacities
        )
        dr.eval(found)
        column = members[np.arange(ends[-1]) + np.repeat(lanes.first[rows] - start, count[rows])]
        distinct = np.unique(rows, return_index=True)[1]
        matrices = []
        for values in found:
            data = np.array(values)[: ends[-1]].astype(np.float64)
            kept = np.abs(data) > _NOTHING
            first = np.concatenate([[0], np.cumsum(kept)])[np.concatenate([[0], ends])]
            matrix = csr_array((data[kept], column[kept], first), shape=(len(rows), splats))
            matrices.append(matrix[distinct])
        yield lanes.pixel[rows][distinct], matrices

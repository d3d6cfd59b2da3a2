"""Which directions of a pose the information sees at all: a statistical decision, then words for the rest.

Everything here is in the camera frame with translation in units of the length scale, so that translations and
rotations compare. An estimate F̂ of an information that is zero along some directions is not zero there but
noise, so the rank r is the smallest for which the largest eigenvalue of F̂ restricted to its trailing 6 − r
eigenvectors stays below λ_99: the 99 % quantile of the largest eigenvalue of N(0, Cov[F̂]) restricted
likewise, plus 1e-9 λ_max for float32 rendering. (A fixed number of standard errors of each eigenvalue would
not do: the largest of six noise eigenvalues exceeds two of them in 81 % of cases.)

An unseen direction is known only up to the tilt that noise gives it. To first order, with seen eigenvectors s
and unseen ones n, it is δn = −Σ_s s (sᵀ δF n) / (λ_s − λ_n).

Reference: Stewart and Sun, "Matrix Perturbation Theory", 1990, chapter V.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..noise.covariance import symmetric_root
from ..se3 import Array
from .symmetric import congruence, unpack

CONFIDENCE = 0.99
"""Probability with which pure noise stays below the threshold."""

FLOAT32_FLOOR = 1e-9
"""Information below this fraction of the largest eigenvalue is lost in float32 rendering."""

SMALLEST_SHARE = 0.01
"""An axis' share of the unseen subspace below this leaves its standard deviation finite."""

SIGNIFICANT = 3.0
"""Standard errors that make a share of the unseen subspace significant."""

_LARGEST_NAMING_TILT = 0.2
# A seen direction is no axis exactly; this part of it may be left out of its description.
_READABLE_TILT = 0.05
_DRAWS = 4096
_WORLD_AXES = ("world axis x", "world axis y", "world axis z")
_CAMERA_AXES = ("the camera's x axis", "the camera's y axis", "the optical axis")
_TURNS = (" (pitch)", " (yaw)", " (roll)")


@dataclass(frozen=True, eq=False)
class PoseDirection:
    """A direction of the pose, in numbers and in words."""

    direction: Array
    """(6,), unit twist in the camera frame, translation in units of the length scale."""
    description: str
    """The same in words."""


@dataclass(frozen=True, eq=False)
class Identifiability:
    """The eigenvectors of an estimated information, split into seen and unseen, with their uncertainty."""

    eigenvalues: Array
    """(6,), descending."""
    eigenvectors: Array
    """(6, 6), in columns, in the order of the eigenvalues."""
    rank: int
    """Number of seen directions, the first columns."""
    threshold: float
    """λ_99 of the unseen subspace, the float32 floor included; 0 if everything is seen."""
    tilt_covariance: Array
    """(r, 6−r, r, 6−r), covariance of (sᵀ δF n) / (λ_s − λ_n)."""
    noise_root: Array
    """(21, 21), takes standard normals (..., 21) to the entries of δF in the eigenvectors' basis."""

    @property
    def seen(self) -> Array:
        """(6, r), orthonormal columns."""
        return self.eigenvectors[:, : self.rank]

    @property
    def unseen(self) -> Array:
        """(6, 6−r), orthonormal columns."""
        return self.eigenvectors[:, self.rank :]

    def has_share(
        self, axes: Array, subspace: Array | None = None
    ) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which axes (m, 6) have a significant share of the unseen subspace, or of a part of it (6, q).

        The share of a unit vector a is ‖Nᵀa‖; it counts if it exceeds both 0.01 and 3 standard errors.
        """
        part = self.unseen if subspace is None else subspace
        units = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        share = np.linalg.norm(units @ part, axis=1)
        inner = self.unseen.T @ part
        variance = np.einsum(
            "as,nq,snto,at,oq->a", units @ self.seen, inner, self.tilt_covariance, units @ self.seen, inner
        )
        error = np.sqrt(np.maximum(variance, 0.0))
        return np.asarray((share > SMALLEST_SHARE) & (share > SIGNIFICANT * error))

    def noise(self) -> Array:
        """(draws, 6, 6), draws of VᵀδFV, V the eigenvectors; always the same ones."""
        return _drawn(self.noise_root)

    def naming_tolerance(self, direction: Array) -> float:
        """Tilt that noise explains: below it an unseen direction (6,) may be called by an axis' name."""
        inner = self.unseen.T @ direction
        variance = float(np.einsum("n,snso,o->", inner, self.tilt_covariance, inner))
        return float(np.clip(SIGNIFICANT * np.sqrt(max(variance, 0.0)), SMALLEST_SHARE, _LARGEST_NAMING_TILT))


def identify(matrix: Array, covariance_of_entries: Array) -> Identifiability:
    """Decide the rank of an estimated information.

    Args:
        matrix: (6, 6), F̂ in the camera frame with scaled translation.
        covariance_of_entries: (21, 21), of its upper triangle; a part that is not positive semi-definite, an
            artefact of its own unbiased estimate, is ignored.
    """
    values, vectors = np.linalg.eigh(matrix)
    values, vectors = values[::-1], vectors[:, ::-1]
    T = congruence(vectors)
    covariance = T @ covariance_of_entries @ T.T
    root = symmetric_root(covariance_of_entries) @ T.T
    noise = _drawn(root)
    floor = FLOAT32_FLOOR * max(float(values[0]), 0.0)
    rank, threshold = 6, 0.0
    for r in range(6):
        # The Frobenius norm bounds the largest eigenvalue and costs little; most seen directions exceed it.
        rest = noise[:, r:, r:]
        if values[r] > np.quantile(np.sqrt(np.sum(rest**2, axis=(1, 2))), CONFIDENCE) + floor:
            continue
        quantile = float(np.quantile(np.linalg.eigvalsh(rest)[:, -1], CONFIDENCE)) + floor
        if not values[r] > quantile:
            rank, threshold = r, quantile
            break
    entries = unpack(np.moveaxis(unpack(covariance), 0, -1))
    gaps = values[:rank, None] - values[None, rank:]
    tilt = entries[:rank, rank:, :rank, rank:] / (gaps[:, :, None, None] * gaps)
    return Identifiability(values, vectors, rank, threshold, tilt, root)


def readable_basis(
    identifiability: Identifiability, unseen: Array, world_from_camera: Array, length_scale: float
) -> tuple[PoseDirection, ...]:
    """An orthonormal basis of the unseen subspace that follows named axes where it can, with descriptions.

    Args:
        identifiability: tells how far noise may have tilted the subspace.
        unseen: (6, q), orthonormal columns: the unseen subspace, or what a prior left of it.
        world_from_camera: the camera's pose, 4 x 4.
        length_scale: scene units per unit of scaled translation.
    """
    rotation = world_from_camera[:3, :3]
    axes = _named_axes(rotation)
    all_translations = unseen.shape[1] < 6 and all(
        _contains(unseen, axis, identifiability) for axis, _ in axes[:3]
    )
    rest, found = unseen, list[PoseDirection]()
    for k, (axis, name) in enumerate(axes):
        if _contains(rest, axis, identifiability):
            direction = rest @ (rest.T @ axis)
            direction /= np.linalg.norm(direction)
            rest = np.linalg.svd(rest - np.outer(direction, direction @ rest))[0][:, : rest.shape[1] - 1]
            description = (
                name.replace("along", "in any direction: along") if all_translations and k < 3 else name
            )
            found.append(PoseDirection(direction, description))
    # Translations among what is left come first: the smallest singular values of the rotation part.
    rest = rest @ np.linalg.svd(rest[3:])[2].T[:, ::-1]
    for direction in rest.T:
        tolerance = identifiability.naming_tolerance(direction)
        found.append(_described(direction, rotation, length_scale, tolerance))
    return tuple(found)


def weakest_direction(
    identifiability: Identifiability, world_from_camera: Array, length_scale: float
) -> PoseDirection | None:
    """The seen direction of the smallest eigenvalue, in words; None if nothing is seen."""
    if identifiability.rank == 0:
        return None
    direction = identifiability.seen[:, -1]
    return _described(direction, world_from_camera[:3, :3], length_scale, _READABLE_TILT)


def _contains(subspace: Array, axis: Array, identifiability: Identifiability) -> bool:
    residual = axis - subspace @ (subspace.T @ axis)
    return bool(np.linalg.norm(residual) <= identifiability.naming_tolerance(axis))


def _named_axes(rotation: Array) -> list[tuple[Array, str]]:
    """Unit twists with names, in the order in which a reader would prefer them."""
    zero = np.zeros((3, 3))
    translations = np.hstack([np.vstack([rotation, np.eye(3)]), np.vstack([zero, zero])])
    rotations = np.hstack([np.vstack([zero, zero]), np.vstack([np.eye(3), rotation])])
    names = [
        *(f"translation along {name}" for name in (*_WORLD_AXES, *_CAMERA_AXES)),
        *(f"rotation about {name}{suffix}" for name, suffix in zip(_CAMERA_AXES, _TURNS, strict=True)),
        *(f"rotation about {name} through the camera" for name in _WORLD_AXES),
    ]
    return list(zip([*translations, *rotations], names, strict=True))


def _described(direction: Array, rotation: Array, length_scale: float, tolerance: float) -> PoseDirection:
    """Words for a direction that is no named axis: a translation, a rotation, or both at once."""
    rho, phi = direction[:3], direction[3:]
    if np.linalg.norm(phi) <= tolerance:
        direction = direction * _sign(rotation @ rho)
        return PoseDirection(direction, _translation(direction[:3], rotation, tolerance))
    direction = direction * _sign(phi)
    rho, phi = direction[:3], direction[3:]
    turn = _turn(phi, rotation, tolerance)
    if np.linalg.norm(rho) <= tolerance:
        return PoseDirection(direction, turn)
    rate = length_scale * float(np.linalg.norm(rho) / np.degrees(np.linalg.norm(phi)))
    shift = _translation(rho, rotation, tolerance)
    return PoseDirection(direction, f"a {turn} together with a {shift}, {rate:.3g} scene units per degree")


def _translation(rho: Array, rotation: Array, tolerance: float) -> str:
    for axes, names in ((rotation, _WORLD_AXES), (np.eye(3), _CAMERA_AXES)):
        for axis, name in zip(axes, names, strict=True):
            if np.linalg.norm(rho - axis * (axis @ rho)) <= tolerance:
                return f"translation {'along' if axis @ rho > 0.0 else 'against'} {name}"
    return f"translation along {_vector(rotation @ rho)} in the world"


def _turn(phi: Array, rotation: Array, tolerance: float) -> str:
    for axis, name, suffix in zip(np.eye(3), _CAMERA_AXES, _TURNS, strict=True):
        if np.linalg.norm(phi - axis * (axis @ phi)) <= tolerance:
            return f"rotation about {name}{suffix}"
    for axis, name in zip(rotation, _WORLD_AXES, strict=True):
        if np.linalg.norm(phi - axis * (axis @ phi)) <= tolerance:
            return f"rotation about {name} through the camera"
    return f"rotation about {_vector(phi)} in the camera's axes"


def _sign(vector: Array) -> float:
    """−1 if the largest component is negative; ties, which rounding would decide, go to the first."""
    magnitude = np.abs(vector)
    return float(np.sign(vector[np.argmax(magnitude > 0.999 * magnitude.max())]))


def _vector(vector: Array) -> str:
    numbers = (f"{v:.2f}".rstrip("0").rstrip(".") for v in vector / np.linalg.norm(vector))
    return "(" + ", ".join("0" if number == "-0" else number for number in numbers) + ")"


def _drawn(root: Array) -> Array:
    return unpack(_standard_normals() @ root).reshape(-1, 6, 6)


@lru_cache(maxsize=1)
def _standard_normals() -> Array:
    """One sample for every decision, so that the same information gives the same rank."""
    # In stacks of 128, whose products are too small to wake BLAS's threads (see `ustatistic`).
    normals = np.random.default_rng(1948).standard_normal((_DRAWS // 128, 128, 21))
    normals.flags.writeable = False
    return normals

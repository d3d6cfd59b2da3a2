"""The Cramér–Rao bound of a camera's pose: F⁻¹ where the image sees, infinity where it does not.

Every unbiased estimator obeys Cov(ξ̂) ⪰ F⁻¹. The directions that the estimated information does not see are
decided first (`identifiability`), in the camera frame with translation in units of the length scale; what
they leave of F⁻¹ is in `inverse`. Conventions: `se3`.

F̂⁻¹ is biased upwards by noise in F̂; the standard errors, by the delta method, say by how much it may matter.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from dataclasses import replace as dataclass_replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from ..errors import NuisanceWarning, OptionError, PrecisionWarning
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.identifiability import PoseDirection, readable_basis, weakest_direction
from ..information.joint import JointInformation
from ..information.resolution import Verdict, paths_to_decide, upper_limits
from ..noise.covariance import positive_matrix
from ..se3 import Array, Frame
from .criteria import Optimality
from .inverse import Inverse
from .prior import PosePrior

ALL_NUISANCES = "all of them"
"""Key of `PoseBound.if_known` for the bound if every nuisance were known."""

LARGEST_RELATIVE_ERROR = 0.1
"""A standard deviation whose relative standard error exceeds this raises a `PrecisionWarning`."""

_POSITION_NAMES = ("x", "y", "z")
_ROTATION_NAMES = ("pitch", "yaw", "roll")
AXES = (*(f"position {axis}" for axis in _POSITION_NAMES), *_ROTATION_NAMES)


# Rows are linear functionals of the scaled camera-frame twist.
TURN = np.degrees(np.hstack([np.zeros((3, 3)), np.eye(3)]))


Verdicts = tuple[Verdict, Verdict, Verdict]


@dataclass(frozen=True, eq=False)
class UnobservedDirection(PoseDirection):
    """A direction that the bound does not see: because there is nothing, or because of too few paths."""

    verdict: Verdict
    """`"unseen"`: certainly below 1e-3 of the best-seen information; else `"not resolved"`."""
    std_lower_limit: float
    """Its standard deviation exceeds this at a confidence of 99 % [length scale and rad, as `direction`]."""
    paths_factor: int | None
    """About so many times the paths decide; None if nothing is to be decided, or nothing to compare with."""


@dataclass(frozen=True, eq=False)
class PoseBound(Record):
    """Lower bounds on the errors of every unbiased estimator of a camera's pose."""

    covariance: Array
    """(6, 6) in `frame`: `inf` on the diagonal of what is unseen, `nan` off it."""
    position_std: Array
    """(3,), the camera centre's standard deviation along the world's axes x, y, z [scene unit]."""
    position_std_standard_error: Array
    """(3,), its Monte Carlo standard error [scene unit]; `nan` where the bound is infinite."""
    rotation_std_deg: Array
    """(3,), rotation about the camera's own axes: pitch x, yaw y, roll z [deg]."""
    rotation_std_deg_standard_error: Array
    """(3,), its Monte Carlo standard error [deg]; `nan` where the bound is infinite."""
    position_verdict: Verdicts
    """Of each: `"seen"` is finite, `"unseen"` certainly has a share of next to no information, and what is
    `"not resolved"` has too few paths to tell."""
    rotation_verdict: Verdicts
    """The same of the rotations."""
    position_std_lower_limit: Array
    """(3,), what the true standard deviations exceed at a confidence of 99 % each [scene unit]."""
    rotation_std_deg_lower_limit: Array
    """(3,), the same of the rotations [deg]."""
    rank: int
    """Number of directions that are seen, by the image or the prior."""
    unobserved: tuple[UnobservedDirection, ...]
    """The other 6 − rank directions: an orthonormal basis in the camera frame, what is unseen first."""
    eigenvalues: Array
    """(6,), descending, of the information in the camera frame with translation in length scales."""
    eigenvalues_standard_error: Array
    """(6,), their standard errors."""
    noise_floor: float
    """λ_99: an unseen direction carries less information than this, in the eigenvalues' unit; 0 at rank 6."""
    information: FisherInformation
    """The information used, the prior included."""
    frame: Frame
    """Frame of `covariance` and `seen_covariance`, `"camera"` or `"world"`."""
    length_scale: float
    """Length that makes translation comparable with rotation [scene unit]."""
    position_covariance: Array
    """(3, 3), of the camera centre, world axes [scene unit²], with `inf` and `nan` as in `covariance`."""
    rotation_covariance_deg2: Array
    """(3, 3), about the camera's axes [deg²], with `inf` and `nan` as in `covariance`."""
    seen_covariance: Array
    """(6, 6) in `frame`: the pseudo-inverse on the seen subspace. It says nothing about what is unseen."""
    weakest: PoseDirection | None
    """The direction that the image itself, without the prior, sees worst but does see; None at rank 0."""
    inverse: Inverse = field(repr=False)
    """Gives the variance of any linear functional of the pose; `to_coordinates` uses it."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """How the information was computed, JSON-able."""
    joint: JointInformation | None = field(default=None, repr=False)
    """What it came from: of the pose and of nuisance parameters, whose marginalization it can undo."""
    if_known: Mapping[str, PoseBound] = field(default_factory=dict, repr=False)
    """By marginalized nuisance: the bound if that one were known; of several also `ALL_NUISANCES`."""

    def to_frame(self, frame: Frame) -> PoseBound:
        """The same bound with its matrices in another frame."""
        twist = twist_functionals(self.inverse, frame)
        return dataclass_replace(
            self,
            frame=frame,
            information=self.inverse.total.to_frame(frame),
            covariance=self.inverse.covariance(twist),
            seen_covariance=self.inverse.seen_covariance(twist),
        )

    @property
    def relative_standard_error(self) -> Array:
        """(6,), of position and rotation, over the standard deviations; `nan` where they are infinite."""
        errors = np.concatenate([self.position_std_standard_error, self.rotation_std_deg_standard_error])
        relative: Array = errors / np.concatenate([self.position_std, self.rotation_std_deg])
        return relative

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Of position and rotation, six."""
        return (*self.position_verdict, *self.rotation_verdict)

    @property
    def optimality(self) -> Optimality:
        """The classical scalars of the information, the prior included."""
        if self.unobserved:
            return Optimality(-np.inf, np.inf, 0.0)
        return Optimality.of(self.inverse.precision)

    def ellipsoid(self, which: Literal["position", "rotation"], sigma: float = 1.0) -> tuple[Array, Array]:
        """The uncertainty ellipsoid of position [scene unit, world axes] or rotation [deg, camera axes].

        Args:
            which: `"position"` or `"rotation"`.
            sigma: semi-axes in standard deviations.

        Returns:
            Semi-axes (3,), descending, infinite where unseen, and their directions (3, 3) in columns.

        Raises:
            OptionError: `which` is neither.
        """
        semi_axes, directions = self.inverse.ellipsoid(self._functionals(which))
        return sigma * semi_axes, directions

    def verdicts_along(self, which: Literal["position", "rotation"], directions: Array) -> Verdicts:
        """Whether each axis of the ellipsoid is seen, unseen or not resolved; `directions` in columns."""
        return _three(self.inverse.verdicts(directions.T @ self._functionals(which)))

    def _functionals(self, which: str) -> Array:
        if which not in ("position", "rotation"):
            raise OptionError(f"there is no ellipsoid {which!r}; expected 'position' or 'rotation'")
        return position_functionals(self.inverse) if which == "position" else TURN

    @property
    def not_resolved(self) -> str | None:
        """What too few paths leave open, and how many would decide, in words; None if that is nothing."""
        axes = [axis for axis, verdict in zip(AXES, self.verdicts, strict=True) if verdict == "not resolved"]
        unresolved = [u for u in self.unobserved if u.verdict == "not resolved"]
        if not (axes or unresolved):
            return None
        what = ", ".join(axes) or "; ".join(u.description for u in unresolved)
        factors = [u.paths_factor for u in unresolved]
        known = [factor for factor in factors if factor is not None]
        how = f"about {max(known)} times as many" if known and len(known) == len(factors) else "more"
        return f"{what}: so few paths cannot tell little information from none; {how} would decide"

    def __str__(self) -> str:
        position = _with_errors(
            _POSITION_NAMES,
            self.position_std,
            self.position_std_standard_error,
            self.position_verdict,
            self.position_std_lower_limit,
        )
        rotation = _with_errors(
            _ROTATION_NAMES,
            self.rotation_std_deg,
            self.rotation_std_deg_standard_error,
            self.rotation_verdict,
            self.rotation_std_deg_lower_limit,
        )
        unseen, unresolved = (
            "; ".join(u.description for u in self.unobserved if u.verdict == verdict)
            for verdict in ("unseen", "not resolved")
        )
        unseen = (unseen or "nothing") + (unresolved and f", not resolved: {unresolved}")
        eigenvalues = ", ".join(f"{value:.3g}" for value in self.eigenvalues)
        return "\n".join(
            (
                f"position std  {position} [scene unit], world axes",
                f"rotation std  {rotation} [deg], camera axes",
                f"rank          {self.rank} of 6",
                f"unseen        {unseen}",
                f"eigenvalues   {eigenvalues} (camera frame, translation in length scales)",
                f"length scale  {self.length_scale:.4g} [scene unit]; matrices in the {self.frame} frame",
            )
        )


def cramer_rao_bound(
    information: FisherInformation, *, prior: FisherInformation | PosePrior | ArrayLike | None = None
) -> PoseBound:
    """The Cramér–Rao bound F⁻¹ of a pose, or (F + P)⁻¹ with a prior.

    What the image sees is decided without the prior, which is then added as it is: it can lower standard
    deviations and raise the rank, never the other way round.

    Args:
        information: of the pose, in any frame; the bound's matrices come in the same one.
        prior: information known beforehand, exact. A `PosePrior` in a frame of its own, a 6 x 6 matrix in
            `information`'s frame, or an information of the same variable, frame and pose, of which the part
            that it sees itself counts.

    Raises:
        FrameError: the prior belongs to another variable, frame or pose.
        OptionError: the prior is no symmetric positive semi-definite 6 x 6 matrix.

    Warns:
        PrecisionWarning: a standard deviation is uncertain by more than 10 %, or so few paths do not resolve
            one.

    References:
        van Trees, "Detection, Estimation, and Modulation Theory", part I, 1968, sections 2.4.2 and 2.4.3.
    """
    if prior is not None and not isinstance(prior, FisherInformation | PosePrior):
        prior = positive_matrix(prior, "the prior's information", OptionError, size=6)
    inverse = Inverse(information, prior)
    position, turn, twist = position_functionals(inverse), TURN, twist_functionals(inverse, information.frame)
    position_covariance, rotation_covariance = inverse.covariance(position), inverse.covariance(turn)
    with np.errstate(invalid="ignore"):
        position_std = np.sqrt(np.diagonal(position_covariance))
        rotation_std = np.sqrt(np.diagonal(rotation_covariance))
    limits = inverse.lower_limits(np.vstack([position, turn]))
    eigenvalues, eigenvalue_errors = inverse.eigenvalues()
    bound = PoseBound(
        covariance=inverse.covariance(twist),
        position_std=position_std,
        position_std_standard_error=inverse.standard_error(position, position_std),
        rotation_std_deg=rotation_std,
        rotation_std_deg_standard_error=inverse.standard_error(turn, rotation_std),
        position_verdict=_three(inverse.verdicts(position)),
        rotation_verdict=_three(inverse.verdicts(turn)),
        position_std_lower_limit=limits[:3],
        rotation_std_deg_lower_limit=limits[3:],
        rank=6 - inverse.open.shape[1],
        unobserved=_unobserved(inverse),
        eigenvalues=eigenvalues,
        eigenvalues_standard_error=eigenvalue_errors,
        noise_floor=inverse.identifiability.threshold,
        information=inverse.total.to_frame(information.frame),
        frame=information.frame,
        length_scale=inverse.length_scale,
        position_covariance=position_covariance,
        rotation_covariance_deg2=rotation_covariance,
        seen_covariance=inverse.seen_covariance(twist),
        weakest=weakest_direction(inverse.identifiability, inverse.total.pose, inverse.length_scale),
        inverse=inverse,
    )
    _warn_of_imprecision(bound)
    return bound


def joint_bound(
    joint: JointInformation, *, prior: FisherInformation | PosePrior | ArrayLike | None = None
) -> PoseBound:
    """The Cramér–Rao bound of a pose among nuisance parameters, in the camera frame, and what each costs.

    Args:
        joint: with every nuisance marginalized or fixed.
        prior: of the pose, see `cramer_rao_bound`.

    Raises:
        NuisanceError: nothing was decided of some nuisance.

    Warns:
        NuisanceWarning: the image does not see a marginalized nuisance, or too few paths do not resolve it.
        PrecisionWarning: see `cramer_rao_bound`.
    """
    bound = cramer_rao_bound(joint.information, prior=prior)
    unknown = [name for name in joint.names if joint.treatment[name] == "marginalized"]
    unseen = [name for name in joint.unseen if name in unknown]
    for names, words in (
        (unseen, "the image does not see {}, so that not knowing it costs nothing"),
        (
            joint.unresolved,
            "so few paths do not tell what not knowing {} costs: the bound is the one with it known, a lower "
            "limit of what was asked for; --spp N with more paths tells",
        ),
    ):
        if names:
            warnings.warn(words.format(", ".join(names)), NuisanceWarning, stacklevel=2)
    known = {name: joint.fix(name) for name in unknown}
    if len(unknown) > 1:
        known[ALL_NUISANCES] = joint.fix(*unknown)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrecisionWarning)
        if_known = {name: cramer_rao_bound(each.information, prior=prior) for name, each in known.items()}
    return dataclass_replace(bound, joint=joint, if_known=if_known)


def twist_functionals(inverse: Inverse, frame: Frame) -> Array:
    """(6, 6), the unscaled twist in a frame."""
    twist = np.diag(inverse.scale)
    return twist if frame == "camera" else se3.adjoint(inverse.total.pose) @ twist


def position_functionals(inverse: Inverse) -> Array:
    """(3, 6), world axes: the camera centre moves by R ρ."""
    return np.hstack([inverse.length_scale * inverse.total.pose[:3, :3], np.zeros((3, 3))])


def _three(verdicts: tuple[Verdict, ...]) -> Verdicts:
    x, y, z = verdicts
    return x, y, z


def _unobserved(inverse: Inverse) -> tuple[UnobservedDirection, ...]:
    """What is unseen and what is not resolved, each in words."""
    found = inverse.identifiability
    parts: tuple[tuple[Verdict, Array], ...] = (
        ("unseen", inverse.resolution.unseen),
        ("not resolved", inverse.resolution.unresolved),
    )
    directions = [
        (verdict, direction)
        for verdict, part in parts
        for direction in readable_basis(found, part, inverse.total.pose, inverse.length_scale)
    ]
    if not directions:
        return ()
    vectors = np.array([direction.direction for _, direction in directions])
    limits = upper_limits(found, vectors)
    return tuple(
        UnobservedDirection(
            direction.direction,
            direction.description,
            verdict,
            1.0 / math.sqrt(limit) if limit > 0.0 else math.inf,
            paths_to_decide(found, limit) if verdict == "not resolved" else None,
        )
        for (verdict, direction), limit in zip(directions, limits.tolist(), strict=True)
    )


def _warn_of_imprecision(bound: PoseBound) -> None:
    relative = np.nan_to_num(bound.relative_standard_error)
    worst = int(np.argmax(relative))
    if relative[worst] > LARGEST_RELATIVE_ERROR:
        name = AXES[worst]
        factor = math.ceil((relative[worst] / LARGEST_RELATIVE_ERROR) ** 2)
        warnings.warn(
            f"the bound on {name} is uncertain by {relative[worst]:.0%} and may be too large; "
            f"about {factor} times the samples would bring that to {LARGEST_RELATIVE_ERROR:.0%}",
            PrecisionWarning,
            stacklevel=3,
        )
    if bound.not_resolved is not None:
        warnings.warn(f"not resolved: {bound.not_resolved}", PrecisionWarning, stacklevel=3)


def _with_errors(
    names: tuple[str, ...], values: Array, errors: Array, verdicts: Verdicts, limits: Array
) -> str:
    parts = (
        f"{name} {value:.3g} ± {error:.1g}"
        if verdict == "seen"
        else f"{name} inf"
        if np.isinf(limit)
        else f"{name} {'inf, ' if verdict == 'unseen' else ''}> {limit:.3g}"
        for name, value, error, verdict, limit in zip(names, values, errors, verdicts, limits, strict=True)
    )
    return ", ".join(parts)

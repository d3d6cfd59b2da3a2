"""Checks that users can run on their own scenes: is this Jacobian right here?

A method is compared with finite differences, column by column. With independent random numbers on both sides
and K batches each, the information of the difference D = J_method − J_h and both informations are estimated
without bias (design section 5), so

    ratio_i = F_method,ii / F_fd,ii,   difference_i = (F_D,ii / F_fd,ii)^½ = ‖D_i‖ / ‖J_fd,i‖.

All methods measure the same pixels, which are chosen once, with random numbers of their own each; what one of
them drops as invalid is left out of the comparison with it.

The reference is measured with two steps, h as it steps by itself and 2h, by the same random numbers. Its bias
goes as h^p, p = 1 with a box filter and 2 with others, whence

    F_fd = F(h) + c_p (F(h) − F(2h)),   c_p = 1 / (2^p − 1).

What the next order would make of it, |c_p − c_{p+1}| |F(h) − F(2h)|, is allowed for. Where the correction is
more than `AGREEMENT`, the steps disagree, and nothing is decided. J_h itself may be off by twice what it is
at an edge (`Stepping`).

Without a number of paths a check goes on in rounds until it can tell. Each has random numbers of its own, and
a size that the round before it has fixed; the last is the answer, and those before it are forgotten. What is
deterministic is measured once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from itertools import count
from typing import Any, Self, Unpack

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError
from ..files import Record
from ..information.fisher import FisherInformation
from ..information.image_information import fisher_information
from ..information.image_jacobian import ImageJacobian
from ..information.joint import joint_information
from ..information.symmetric import triangle
from ..jacobian.finite_difference import steps_of
from ..noise import Gaussian, NoiseModel
from ..render.random import derived_seed
from .measurement import measurement
from .opening import as_world, kind_of, open_measurable, wanted
from .options import CHECKING, MeasurementKeywords, MeasurementOptions

AGREEMENT = 0.05
"""The smallest disagreement that a check must be able to see before it may say "agree"."""

_SIGMAS = 3.0
_MOST = 1 << 22
"""Paths in all, beside 24 times as many of the reference, within which `max_spp` is by default..."""
_FEWEST_MOST = 256
"""... but not below this."""
_LEAP = 8
"""Times the paths of one round, the most that the next has: few paths tell little of how many it takes."""
_ROUND = 0x4348434B
"""Purpose of a round's seed."""


@dataclasses.dataclass(frozen=True)
class MethodCheck(Record):
    """One method beside finite differences."""

    method: str
    ratio: NDArray[np.float64]
    """(6,) F_method,ii / F_fd,ii, NaN for a column that finite differences do not see."""
    ratio_standard_error: NDArray[np.float64]
    """(6,)"""
    difference: NDArray[np.float64]
    """(6,) ‖J_method,i − J_h,i‖ / ‖J_fd,i‖, freed of both sides' noise, 0 if that leaves nothing."""
    difference_standard_error: NDArray[np.float64]
    """(6,) its standard error, by the delta method; at difference 0 that of the largest it could hide."""
    detectable: NDArray[np.float64]
    """(6,) the smallest |ratio − 1| that would have been seen: 3 standard errors and the reference's bias.
    Infinite where nothing would have been: the reference's steps disagree, or it does not see what the method
    sees. NaN for a column that neither sees."""
    disagrees: NDArray[np.bool_]
    """(6,) whether ratio or difference exceed what chance and the reference's bias explain."""
    paths: float
    """So many times the paths would decide what is undecided, if no column disagrees: 1 if nothing is,
    infinite if no number would."""

    @property
    def undecided(self) -> NDArray[np.bool_]:
        """(6,) whether a column neither disagrees, nor would have been seen to."""
        return np.asarray(~self.disagrees & (self.detectable > AGREEMENT))


@dataclasses.dataclass(frozen=True)
class JacobianCheck(Record):
    """Methods beside finite differences on one view, and what follows."""

    rows: tuple[MethodCheck, ...]
    detectable: float
    """The smallest relative disagreement in F_ii that every column would have shown; infinite if there is
    none to compare, or one in which nothing would have been seen."""
    reference_bias: NDArray[np.float64]
    """(6,) relative bias that may be left in F_fd,ii; infinite where its steps disagree or see nothing."""
    step_pixels: float
    """Image motion of the shorter step [pixel]."""
    paths: int | None
    """Paths per pixel that would decide, about; None if it is decided, or no number would."""
    spp: int | None
    """Paths per pixel that this took; finite differences trace 12 times that, at two steps. None of what is
    deterministic."""

    @property
    def disagreeing(self) -> list[str]:
        """The methods that differ from finite differences in some column."""
        return [row.method for row in self.rows if row.disagrees.any()]

    @property
    def verdict(self) -> str:
        """ "agree", "disagree" or "inconclusive"."""
        if self.disagreeing:
            return "disagree"
        return "agree" if self.detectable <= AGREEMENT else "inconclusive"

    @property
    def exit_code(self) -> int:
        """0 agree, 1 disagree, 3 inconclusive."""
        return {"agree": 0, "disagree": 1, "inconclusive": 3}[self.verdict]

    @property
    def cure(self) -> str:
        """What would decide, if anything is undecided; else nothing."""
        if self.verdict != "inconclusive":
            return ""
        if self.paths is not None:
            return f"about {self.paths} paths per pixel would tell"
        if any(np.isfinite(row.ratio).any() for row in self.rows):
            steps = f"{self.step_pixels:.2g} and {2.0 * self.step_pixels:.2g} pixels"
            return f"finite differences by {steps} disagree, or are too long here: no paths mend that"
        return "there is no column to compare"

    def __str__(self) -> str:
        lines = [
            f"{row.method}: F / F_fd = "
            + ", ".join(
                f"{r:.3f} ± {e:.3f}" for r, e in zip(row.ratio, row.ratio_standard_error, strict=True)
            )
            for row in self.rows
        ]
        said = self.cure or f"would have seen {100 * self.detectable:.2g} %"
        return "\n".join([*lines, f"{self.verdict}; {said}"])


def check_jacobian(
    scene: Any,
    *,
    methods: Sequence[str] | None = None,
    **options: Unpack[MeasurementKeywords],
) -> JacobianCheck:
    """Compare methods with finite differences on one view.

    Args:
        scene: as for `pose_bound`.
        methods: names of the methods to check; by default that of a bound.
        options: see `MeasurementOptions`, of which `method` and `step_pixels` are set here; defaults in
            `options.CHECKING`. Finite differences trace 12 times `spp`, at two steps. Without `spp` there are
            rounds until the verdict stands, or the next would take more than `max_spp`: by default 256, or
            as many as are 2^22 in all.

    Returns:
        `JacobianCheck`; its `exit_code` is 0 (agree within what was detectable, and that is at most 5 %), 1
        (disagree) or 3 (inconclusive: `paths` says how many would decide, if that is it).

    Raises:
        OptionError: no method, an unknown one, or a precision: it is `AGREEMENT`.
    """
    options = {**CHECKING, **options}
    given = MeasurementOptions(**options)
    if given.precision is not None:
        raise OptionError(f"a check tells at {AGREEMENT:.0%}; leave out precision, or give spp or max_spp")
    loaded, _ = as_world(scene, wanted(given))
    kind = kind_of(loaded)
    checked = [name for name in kind.methods if name != kind.reference.name]
    methods = checked[:1] if methods is None else methods
    unknown = [name for name in methods if name not in checked]
    if unknown or not methods:
        raise OptionError(f"methods to check: {', '.join(checked)}; got {', '.join(unknown) or 'none'}")
    with measurement(loaded, **options) as run:
        fixed: MeasurementKeywords = {**options, "pixels": run.mask, "max_spp": None}
    if given.spp is not None or kind.deterministic:
        return _checked(loaded, methods, fixed)
    spp = given.uniform_spp
    most = max(_FEWEST_MOST, _MOST // int(fixed["pixels"].sum())) if given.max_spp is None else given.max_spp
    for number in count():
        spp = min(spp, most - most % given.batches)
        seed = derived_seed(given.seed, _ROUND, number)
        found = _checked(loaded, methods, {**fixed, "spp": spp, "seed": seed >> 1})
        if found.paths is None or 2 * spp > most:
            break
        spp = min(max(2 * spp, found.paths), _LEAP * spp)
    return found


def _checked(scene: Any, methods: Sequence[str], options: MeasurementKeywords) -> JacobianCheck:
    """By as many paths and at the pixels that the options say."""
    given = MeasurementOptions(**options)
    with open_measurable(scene, given) as view:
        reference, deterministic, measured = view.reference, view.deterministic, view.measured
        step, order, misfit, scatter = reference.stepping(view)
        off = math.sqrt(misfit)
        # Translation steps have a longest, which takes both to the same bias.
        doubled = steps_of(view, 2.0 * step) > 1.9 * steps_of(view, step)

    def jacobian(method: str, stream: int, step_pixels: float | None = None) -> ImageJacobian:
        own: MeasurementKeywords = {
            **options,
            "method": method,
            "seed": given.seed + stream,
            "step_pixels": step_pixels,
        }
        with measurement(scene, **own) as run:
            run.warn_of_limits()
            return run.jacobian()

    # The same random numbers at both steps, so that their difference is the bias and less of the noise.
    fine, coarse = (jacobian(reference.name, 1, length) for length in (step, 2.0 * step))
    noise = measured.noise(Gaussian(float(np.nanmax(np.abs(fine.image))) or 1.0))
    rows = []
    for index, method in enumerate(methods):
        own = jacobian(method, 2 + index)
        steps = _Steps.of(fine.at(own.pixels), coarse.at(own.pixels), order, doubled, noise)
        ours = fisher_information(own.at(fine.pixels).at(coarse.pixels), noise)
        rows.append(_compare(method, ours, steps, fisher_information(own - fine, noise), off, scatter))
    known = [row.detectable[~np.isnan(row.detectable)] for row in rows]
    needed = max(row.paths for row in rows)
    more_would_tell = 1.0 < needed < np.inf and not deterministic
    return JacobianCheck(
        tuple(rows),
        max((float(values.max()) for values in known if values.size), default=np.inf),
        _Steps.of(fine, coarse, order, doubled, noise).bias,
        step,
        int(given.uniform_spp * 2 ** np.ceil(np.log2(needed))) if more_would_tell else None,
        None if deterministic else given.uniform_spp,
    )


@dataclasses.dataclass(frozen=True)
class _Steps:
    """What two steps say of the diagonal of F and of its bias; each (6,)."""

    fine: NDArray[np.float64]
    """F(h), which sets the scale of what is noise."""
    fine_error: NDArray[np.float64]
    scale: NDArray[np.float64]
    """See `FisherInformation.scale`."""
    information: NDArray[np.float64]
    """F_fd, extrapolated."""
    error: NDArray[np.float64]
    left: NDArray[np.float64]
    """By how much F_fd may be wrong if the next order were right."""
    left_by_chance: NDArray[np.float64]
    """The part of `left` that noise explains."""
    disagree: NDArray[np.bool_]
    """Whether the correction is too large to be trusted, or there is none, as the steps are not h and 2h."""

    @classmethod
    def of(
        cls,
        fine: ImageJacobian,
        coarse: ImageJacobian,
        order: int,
        doubled: NDArray[np.bool_],
        noise: NoiseModel,
    ) -> Self:
        """From the Jacobians at both steps; pixels that one of them lacks are left out."""
        fine, coarse = fine.at(coarse.pixels), coarse.at(fine.pixels)
        names = tuple(f"step {axis}" for axis in range(6))
        change = fine.batch_values - coarse.batch_values
        both = joint_information(
            dataclasses.replace(
                fine,
                batch_values=np.concatenate([fine.batch_values, change], axis=-1),
                parameters=names,
                bias=None,  # which `left` allows for
            ),
            noise,
        )
        rows, columns = triangle(12)

        def combined(own: float, mixed: float, square: float) -> tuple[NDArray[np.float64], ...]:
            """own ‖J_h‖² + 2 mixed J_h·ΔJ + square ‖ΔJ‖², ΔJ = J_h − J_2h, and its standard error."""
            G = np.zeros((6, len(rows)))
            for axis in range(6):
                for i, j, factor in ((0, 0, own), (0, 6, 2.0 * mixed), (6, 6, square)):
                    G[axis, (rows == axis + i) & (columns == axis + j)] = factor
            variance = np.sum(G @ both.covariance_of_entries * G, axis=1)
            return G @ both.matrix[rows, columns], np.sqrt(np.maximum(variance, 0.0))

        now, later = (1.0 / (2.0**p - 1.0) for p in (order, order + 1))
        # F(h) − F(2h) = 2 J_h·ΔJ − ‖ΔJ‖²
        information, error = combined(1.0, now, -now)
        effect, effect_error = combined(0.0, 1.0, -1.0)
        f, f_error = combined(1.0, 0.0, 0.0)
        size, chance = np.abs(effect), _SIGMAS * effect_error
        return cls(
            fine=f,
            fine_error=f_error,
            scale=both.fix().information.scale,
            information=information,
            error=error,
            left=(now - later) * size,
            left_by_chance=(now - later) * np.minimum(size, chance),
            disagree=~doubled | (now * (size - chance) > AGREEMENT * np.maximum(information, f)),
        )

    @property
    def bias(self) -> NDArray[np.float64]:
        """(6,) `left` over F_fd; infinite where the steps disagree, or nothing is seen."""
        bias: NDArray[np.float64] = np.full(6, np.inf)
        seen = (self.information > 0.0) & ~self.disagree
        return np.divide(self.left, self.information, out=bias, where=seen)


def _compare(
    method: str,
    own: FisherInformation,
    steps: _Steps,
    difference: FisherInformation,
    off: float,
    scatter: float,
) -> MethodCheck:
    f, f_fd, f_d = np.diag(own.matrix), steps.information, np.diag(difference.matrix)
    e, e_fd, e_d = np.diag(own.standard_error), steps.error, np.diag(difference.standard_error)
    # Columns are compared on the scale of the best-seen translation or rotation of the reference: below 1e-6
    # of it a column is float32 rounding.
    largest = np.max(np.maximum(steps.fine, 0.0) * steps.scale**2) / steps.scale**2
    seen = (f_fd > np.maximum(_SIGMAS * e_fd, 1e-6 * largest)) & (
        steps.fine > np.maximum(_SIGMAS * steps.fine_error, 1e-6 * largest)
    )
    claimed = f > np.maximum(_SIGMAS * np.hypot(e, e_fd), 1e-6 * largest)
    # What the reference does not see it may have missed: that is no alarm, and no agreement unless it is sure
    # that there is next to nothing.
    unknown = ~seen & (claimed | (_SIGMAS * e_fd > AGREEMENT * largest))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(seen, f / f_fd, np.nan)
        ratio_error = np.where(seen, np.hypot(np.hypot(e, ratio * e_fd) / f_fd, scatter), np.nan)
        relative = np.where(seen, np.sqrt(np.maximum(f_d, 0.0) / f_fd), np.nan)
        hidden = np.sqrt(np.maximum(f_d, e_d) / f_fd)
        relative_error = np.where(seen, 0.5 * e_d / f_fd / hidden, np.nan)
        detectable = np.where(seen, _SIGMAS * ratio_error + steps.bias, np.where(unknown, np.inf, np.nan))
        chance = _SIGMAS * ratio_error + steps.left_by_chance / f_fd
        times = np.square(chance / (AGREEMENT - (detectable - chance)))
    allowed = max(2.0 * off, 0.02) ** 2 * f_fd
    apart = f_d - _SIGMAS * e_d > allowed
    disagrees = seen & ~steps.disagree & ((np.abs(ratio - 1.0) > detectable) | apart)
    # A reference that saw nothing has no error to go by: four times as many paths may show more.
    times = np.where(seen, np.where(steps.disagree, np.inf, times), np.where(unknown, 4.0, 1.0))
    paths = max(1.0, float(times[~disagrees].max(initial=1.0)))
    return MethodCheck(method, ratio, ratio_error, relative, relative_error, detectable, disagrees, paths)

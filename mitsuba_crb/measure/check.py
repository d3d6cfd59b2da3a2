"""Checks that users can run on their own scenes: is this Jacobian right here?

A method is compared with finite differences, column by column. With independent random numbers on both sides
and K batches each, the information of the difference D = J_method − J_fd and both informations are estimated
without bias (design section 5), so

    ratio_i = F_method,ii / F_fd,ii,   difference_i = (F_D,ii / F_fd,ii)^½ = ‖D_i‖ / ‖J_fd,i‖.

All methods measure the same pixels, which are chosen once, with random numbers of their own each; what one of
them drops as invalid is left out of the comparison with it. The reference's own bias follows from a second
step, twice as long: F(h) − F(0) ≈ (F(2h) − F(h)) / 3.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError
from ..files import Record
from ..information.accumulate import fisher_information
from ..information.fisher import FisherInformation
from ..information.image_jacobian import ImageJacobian
from ..jacobian.methods import METHODS, REFERENCE
from ..noise import Gaussian
from ..render.scene import as_scene
from .measurement import measurement
from .mitsuba_view import wanted
from .options import CHECKING, MeasurementKeywords, MeasurementOptions

AGREEMENT = 0.05
"""The smallest disagreement that a check must be able to see before it may say "agree"."""

CHECKED = tuple(name for name in METHODS if name != REFERENCE.name)
"""What can be checked, and is unless the user names methods."""

_SIGMAS = 3.0


@dataclasses.dataclass(frozen=True)
class MethodCheck(Record):
    """One method beside finite differences."""

    method: str
    ratio: NDArray[np.float64]
    """(6,) F_method,ii / F_fd,ii, NaN for a column that neither sees."""
    ratio_standard_error: NDArray[np.float64]
    """(6,)"""
    difference: NDArray[np.float64]
    """(6,) ‖J_method,i − J_fd,i‖ / ‖J_fd,i‖, freed of both sides' noise, 0 if that leaves nothing."""
    difference_standard_error: NDArray[np.float64]
    """(6,) its standard error, by the delta method; at difference 0 that of the largest it could hide."""
    detectable: NDArray[np.float64]
    """(6,) the smallest |ratio − 1| that would have been seen: 3 standard errors and the reference's bias."""
    disagrees: NDArray[np.bool_]
    """(6,) whether ratio or difference exceed what chance and the reference's bias explain."""


@dataclasses.dataclass(frozen=True)
class JacobianCheck(Record):
    """Methods beside finite differences on one view, and what follows."""

    rows: tuple[MethodCheck, ...]
    detectable: float
    """The smallest relative disagreement in F_ii that every column would have shown."""
    reference_bias: NDArray[np.float64]
    """(6,) relative bias of the finite-difference F_ii, from a second step."""

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

    def __str__(self) -> str:
        lines = [
            f"{row.method}: F / F_fd = "
            + ", ".join(
                f"{r:.3f} ± {e:.3f}" for r, e in zip(row.ratio, row.ratio_standard_error, strict=True)
            )
            for row in self.rows
        ]
        return "\n".join([*lines, f"{self.verdict}; would have seen {100 * self.detectable:.2g} %"])


def check_jacobian(
    scene: Any, *, methods: Sequence[str] = CHECKED, **options: Unpack[MeasurementKeywords]
) -> JacobianCheck:
    """Compare methods with finite differences on one view.

    Args:
        scene: path of a Mitsuba XML file, dictionary, or `mi.Scene`.
        methods: names of the methods to check.
        options: see `MeasurementOptions`, of which `method` and `step_pixels` are set here; defaults in
            `options.CHECKING`. Finite differences trace 12 times `spp`, at two steps.

    Returns:
        `JacobianCheck`; its `exit_code` is 0 (agree within what was detectable, and that is at most 5 %), 1
        (disagree) or 3 (inconclusive: more samples are needed).

    Raises:
        OptionError: no method, or an unknown one.
    """
    unknown = [name for name in methods if name not in CHECKED]
    if unknown or not methods:
        raise OptionError(f"methods to check: {', '.join(CHECKED)}; got {', '.join(unknown) or 'none'}")

    options = {**CHECKING, **options}
    loaded, _ = as_scene(scene, wanted(MeasurementOptions(**options)))
    with measurement(loaded, **options) as run:
        options["pixels"], given = run.mask, run.options

    def jacobian(method: str, stream: int, steps: float = 1.0) -> ImageJacobian:
        own: MeasurementKeywords = {
            **options,
            "method": method,
            "seed": given.seed + stream,
            "step_pixels": steps * MeasurementOptions.step_pixels,
        }
        with measurement(loaded, **own) as view:
            view.warn_of_limits()
            return view.jacobian()

    reference = jacobian(REFERENCE.name, 1)
    noise = Gaussian(float(np.nanmax(np.abs(reference.image))) or 1.0)
    # The same random numbers at both steps, so that their difference is the bias and not the noise.
    bias = _relative_bias(reference, jacobian(REFERENCE.name, 1, 2.0), noise)
    rows = []
    for index, method in enumerate(methods):
        own = jacobian(method, 2 + index)
        ours, theirs, difference = (
            fisher_information(each, noise)
            for each in (own.at(reference.pixels), reference.at(own.pixels), own - reference)
        )
        rows.append(_compare(method, ours, theirs, difference, bias))
    seen = [row.detectable[np.isfinite(row.detectable)] for row in rows]
    return JacobianCheck(tuple(rows), max((float(d.max()) for d in seen if d.size), default=np.inf), bias)


def _relative_bias(fine: ImageJacobian, coarse: ImageJacobian, noise: Gaussian) -> NDArray[np.float64]:
    """(6,) of the diagonal of the fine step's information; infinite for a column that is not seen."""
    truth, doubled = (
        np.diag(fisher_information(each, noise).matrix)
        for each in (fine.at(coarse.pixels), coarse.at(fine.pixels))
    )
    # Infinity keeps a column out of every comparison.
    bias: NDArray[np.float64] = np.full(6, np.inf)
    return np.divide(np.abs(doubled - truth) / 3.0, truth, out=bias, where=truth > 0.0)


def _compare(
    method: str,
    own: FisherInformation,
    fd: FisherInformation,
    difference: FisherInformation,
    bias: NDArray[np.float64],
) -> MethodCheck:
    f, f_fd, f_d = (np.diag(item.matrix) for item in (own, fd, difference))
    e, e_fd, e_d = (np.diag(item.standard_error) for item in (own, fd, difference))
    # Columns are compared on the scale of the best-seen translation or rotation of the reference: below 1e-6
    # of it a column is float32 rounding.
    scale = fd.scale**2
    floor = 1e-6 * np.max(f_fd * scale) / scale
    seen = f_fd > np.maximum(_SIGMAS * e_fd, floor)
    claimed = f > np.maximum(_SIGMAS * np.hypot(e, e_fd), floor)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(seen, f / f_fd, np.where(claimed, np.inf, np.nan))
        ratio_error = np.where(seen, np.hypot(e, ratio * e_fd) / f_fd, np.nan)
        relative = np.where(seen, np.sqrt(np.maximum(f_d, 0.0) / f_fd), np.nan)
        hidden = np.sqrt(np.maximum(f_d, e_d) / f_fd)
        relative_error = np.where(seen, 0.5 * e_d / f_fd / hidden, np.nan)
    detectable = np.where(seen, _SIGMAS * ratio_error + bias, np.nan)
    allowed = np.square(np.where(seen, np.maximum(2.0 * bias, 0.02), 0.0)) * f_fd
    disagrees = np.where(seen, (np.abs(ratio - 1.0) > detectable) | (f_d - _SIGMAS * e_d > allowed), claimed)
    return MethodCheck(method, ratio, ratio_error, relative, relative_error, detectable, disagrees)

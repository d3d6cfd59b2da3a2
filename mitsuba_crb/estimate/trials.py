"""Monte Carlo trials: does an estimator attain the bound on this scene, and is its covariance what F⁻¹ says?

Each trial adds noise to the expected image, perturbs the pose, aligns (`align`) and keeps the error
ξ = log(truth⁻¹ estimate), see `trial`. Expected image, Jacobian and bound are measured once at the truth. The
expected image is *defined* as that render: tied to it (`misfit.Anchor`), the estimator's own render of the
true pose is exact, and away from it unbiased, so that the renderer's noise adds no bias and only the variance
that `excess` states; `renderer_part` frees the errors of it, and says what they tell. How many paths make it
small is foretold before the trials start (`foretold`), unless their number is given.

A trial has failed if its search did not end, or ended where the image does not fit; failures are counted
apart.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from scipy import stats

from .. import se3
from ..bound.consistency import Consistency, consistency
from ..bound.cramer_rao import PoseBound, cramer_rao_bound
from ..errors import PrecisionWarning, TrialError
from ..files import Record
from ..information.image_information import fisher_information
from ..information.image_jacobian import ImageJacobian
from ..information.symmetric import unpack
from ..measure.opening import as_world, fingerprint, kind_of, wanted
from ..measure.options import MeasurementKeywords, MeasurementOptions
from ..noise import Gaussian
from ..processes import in_processes
from ..render.backend import same_variant
from ..render.fingerprint import mask_fingerprint
from ..render.scene import SceneFile
from ..se3 import Array
from .foretold import settled
from .renderer_part import SMALL, RendererPart, Verdict, renderer_part
from .trial import Setup, Trial, run_trials
from .trial_record import recorded, resumed, write_record
from .truth import truth_of

_MEASURED = ("sensor", "method", "seed", "batches", "size", "drop_invalid", "step_pixels", "versions")
"""What of the settings the expected image's provenance says."""
_CHUNK = 4

Progress = Callable[[int, int], None]
"""Called after each trial with the trials done and all of them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Validation(Record):
    """All trials and what they say of the bound."""

    settings: dict[str, Any]
    """What the trials depend on, JSON-able."""
    trials: tuple[Trial, ...]
    """In the order of their numbers."""
    failed: tuple[int, ...]
    """Numbers of the trials that did not end, or ended where the image does not fit."""
    bound: PoseBound
    """At the truth."""
    consistency: Consistency
    """Of the trials that did not fail."""
    rmse_position: float
    """Root mean square distance of the camera centre [scene unit]."""
    rmse_rotation_deg: float
    """Root mean square angle [deg]."""
    bound_position: float
    """Its bound, the root of the position covariance's trace [scene unit]."""
    bound_rotation_deg: float
    """Its bound [deg]."""
    renderer: RendererPart
    """What the renderer's noise has added to the errors, and what they say without it."""
    further: tuple[Trial, ...] = ()
    """What the file that was resumed holds beyond; not judged, but kept."""

    @property
    def excess(self) -> float:
        """The part by which the renderer's noise raises the errors' variances."""
        return self.renderer.excess

    @property
    def verdict(self) -> Verdict:
        """ "consistent", "inconsistent", or "inconclusive" where the renderer's noise decides."""
        return self.renderer.verdict

    @property
    def exit_code(self) -> int:
        """0 consistent, 1 inconsistent, 3 inconclusive."""
        return {"consistent": 0, "inconsistent": 1, "inconclusive": 3}[self.verdict]

    @property
    def cure(self) -> str:
        """What would tell, if it is inconclusive; else nothing."""
        if self.verdict != "inconclusive":
            return ""
        return f"about {int(self.settings['spp'] * self.renderer.times)} paths per pixel would tell"

    @property
    def errors(self) -> Array:
        """(n, 6), of the trials that did not fail."""
        return np.array([trial.error for trial in self.trials if trial.index not in self.failed])

    @property
    def squares(self) -> Array:
        """(n,), their ξᵀFξ, χ²_6 if the bound is attained."""
        F = self.bound.information.to_frame("camera").matrix
        return np.asarray(np.einsum("ni,ij,nj->n", self.errors, F, self.errors))

    @property
    def efficiency(self) -> float:
        """6 / NEES: 1 for an estimator that attains the bound."""
        return 6.0 / self.consistency.nees


def validate(
    scene: Any,
    *,
    trials: int = 100,
    perturb_deg: float = 0.5,
    perturb_trans: float = 0.01,
    sigma: float | None = None,
    assumed_sigma: float | None = None,
    estimator: str = "gauss_newton",
    levels: int = 0,
    iterations: int = 30,
    confidence: float = 0.95,
    workers: int | None = 1,
    resume: Path | None = None,
    on_trial: Progress | None = None,
    defines: Mapping[str, str] | None = None,
    **options: Unpack[MeasurementKeywords],
) -> Validation:
    """Run trials and compare their errors with the bound.

    Args:
        scene: as for `pose_bound`; with several workers a path.
        trials: how many, at least 7.
        perturb_deg: starts are drawn uniformly from the ball of rotations up to this angle [deg].
        perturb_trans: the same for translation [scene unit].
        sigma: standard deviation of the pixel noise [radiance]; None is that of the default camera, which
            does not saturate here: trials are of Gaussian noise.
        assumed_sigma: the bound's, if it shall be another one: a negative control.
        estimator, levels, iterations: as for `align`.
        confidence: of all bands and intervals.
        workers: processes; None: as many as cores.
        resume: a JSON file of an earlier run with the same settings, of the same scene, by the same versions;
            its trials are kept, be they more than `trials`, and new ones are written to it as they end.
        on_trial: called after each trial.
        defines: the scene file's `<default>`s.
        options: see `MeasurementOptions`. The bound is that of the pixels that `pixels` chooses, which are
            all that the estimator has. Without `spp` the paths are so many that the renderer's part of the
            errors is foretold to be below `precision` (0.05), at most `max_spp` per pixel: by default 256,
            or as many as render the expected image by 2^24 in all.

    Raises:
        TrialError: too few trials, a resume file of other settings, or too few that did not fail.
        MitsubaCRBError: as `align`.
    """
    if trials < 7:
        raise TrialError(f"at least 7 trials are needed for a covariance of six numbers; got {trials}")
    if perturb_deg < 0.0 or perturb_trans < 0.0:
        raise TrialError("perturb_deg and perturb_trans must not be negative")
    record = recorded(resume)
    named = dict(defines or {})
    source = SceneFile(scene, named) if isinstance(scene, str | Path) else scene
    given = MeasurementOptions(**options)
    loaded, _ = as_world(source, wanted(given))
    limit = SMALL if given.precision is None else given.precision
    if given.spp is None:
        options = settled(loaded, sigma, options)
    anchor, jacobian, chosen, names = truth_of(loaded, sigma, options)
    selection = dataclasses.asdict(jacobian.selection)
    settings = {
        "scene": str(scene) if isinstance(scene, str | Path) else names["scene"],
        "scene_contents": fingerprint(loaded, scene, named),
        "defines": named,
        "sigma": chosen,
        "perturb_deg": float(perturb_deg),
        "perturb_trans": float(perturb_trans),
        "estimator": estimator,
        "levels": levels,
        "iterations": iterations,
        **{name: jacobian.provenance[name] for name in _MEASURED},
        "pixels": {**selection, "mask": mask_fingerprint(np.isfinite(anchor.batches[0]).all(axis=2))},
        **({} if given.camera is None else {"camera": given.camera.to_dict()}),
        "spp": 0 if kind_of(loaded).deterministic else options["spp"],
        "integrator": names["integrator"],
        "pose": [[round(value, 9) for value in row] for row in anchor.pose.tolist()],
    }
    done = resumed(record, settings)
    shared = Setup(
        scene if isinstance(scene, str | Path) else loaded, named, anchor, chosen, settings, options
    )
    missing = [index for index in range(trials) if index not in done]
    chunks = [(shared, missing[k : k + _CHUNK]) for k in range(0, len(missing), _CHUNK)]
    if workers == 1:
        chunks = [(dataclasses.replace(shared, scene=loaded), indices) for _, indices in chunks]
    for _, results in in_processes(run_trials, chunks, workers, prepare=same_variant()):
        done |= {trial.index: trial for trial in results}
        if resume is not None:
            done = resumed(recorded(resume), settings) | done  # another run may have written meanwhile
            write_record(resume, settings, done)
        if on_trial is not None:
            on_trial(sum(index < trials for index in done), trials)
    ordered = [done[index] for index in sorted(done)]
    noise = Gaussian(chosen if assumed_sigma is None else assumed_sigma)
    result = _judge(settings, tuple(ordered[:trials]), jacobian, noise, confidence, limit)
    return dataclasses.replace(result, further=tuple(ordered[trials:]))


def _judge(
    settings: dict[str, Any],
    trials: tuple[Trial, ...],
    jacobian: ImageJacobian,
    noise: Gaussian,
    confidence: float,
    limit: float,
) -> Validation:
    information = fisher_information(jacobian, noise)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrecisionWarning)
        bound = cramer_rao_bound(information)
    # The residual's square is about χ²_M/M; a pose that is wrong is further off than chance by far.
    values = 3 * len(jacobian.pixels)
    largest = float(np.sqrt(stats.chi2.isf(1e-9, values) / values)) * 1.05
    failed = tuple(t.index for t in trials if t.status != "converged" or t.residual > largest)
    good = [t for t in trials if t.index not in failed]
    if len(good) < 7:
        raise TrialError(
            f"{len(failed)} of {len(trials)} trials failed, too few are left to judge: start nearer "
            "(--perturb-deg, --perturb-trans), or reach further (--levels)"
        )
    errors = np.array([t.error for t in good])
    moved = se3.exp(errors)
    distance = np.linalg.norm(moved[:, :3, 3], axis=1)
    angle = np.linalg.norm(errors[:, 3:], axis=1)
    return Validation(
        settings=settings,
        trials=trials,
        failed=failed,
        bound=bound,
        consistency=consistency(errors, information, confidence=confidence),
        rmse_position=float(np.sqrt(np.mean(distance**2))),
        rmse_rotation_deg=float(np.degrees(np.sqrt(np.mean(angle**2)))),
        bound_position=float(np.sqrt(np.trace(bound.position_covariance))),
        bound_rotation_deg=float(np.sqrt(np.trace(bound.rotation_covariance_deg2))),
        renderer=renderer_part(
            errors,
            information,
            unpack(np.mean([t.added for t in good], axis=0)),
            confidence=confidence,
            limit=limit,
        ),
    )

"""The paper's calibration figure on our scenes: are the errors of an estimator what the bound says?

    python benchmarks/paper/calibration.py     # half an hour on 2 cores; writes CSV and PNG beside it

Trials of Gauss–Newton (`mitsuba_crb.estimate.trials`) at 32 x 24 pixels, starts within 0.2 degrees and 1 cm
`textured_room` (high texture) and `plain_room` (low texture). Both show direct light only, here by four
samples of the window per path. Trials are kept in `trials/` as they end; the same command resumes there.
`calibration.csv` has what is judged, with bands, beside the bound of the noise and, as a negative control, of
half of it; `directions.csv` names the directions of the variance ratios, one standard deviation of the bound
along each.

High SNR (sigma 0.05): three times 400 trials in the textured room have NEES 6.04, 6.19 and 6.05 for 6; every
ratio of variances and every coverage is inside its 95 % band. So are those of 200 trials in the plain room:
no direction carries an excess (empirical over bound 0.97 to 1.00 by axis), since what texture does not tell
is in the bound already. Beside the bound of half the noise all fail. At sigma 0.01 the renderer's noise, a
staircase as edges cross samples, is larger beside the sensor's (excess 5 %), and 60 trials in each scene,
with the same noise, lie at the edge of the 95 % band, roll and y 1.1 to 1.3 times the bound.

Low SNR: errors have the bound's size as long as the search ends, up to sigma 2, with tails first: at 0.8,
93 % are inside the region of 99 %. Gauss–Newton takes the image to be linear in the pose; where the bound
itself is as wide as the scene (a metre, 15 degrees, at sigma 6) it is not. Three in four searches are lost
there; those left, near the start by selection, say nothing of the bound.
"""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mitsuba_crb.bound.consistency import Consistency, consistency
from mitsuba_crb.estimate.trials import Validation, validate
from mitsuba_crb.show.trials_page import draw_calibration

HERE = Path(__file__).parent
SCENES = {"high texture": "textured_room", "low texture": "plain_room"}
COLOURS = {"high texture": "#e6550d", "low texture": "#2166ac"}
HIGH_SNR = 0.05
CONFIDENCES = (0.95, 0.999)
AXES = ("x", "y", "z", "pitch", "yaw", "roll")
UNITS = ("cm", "cm", "cm", "deg", "deg", "deg")
NAMED_SHARE = 0.25
"""An axis names a direction that carries more than this of the variance of its bound."""


@dataclasses.dataclass(frozen=True)
class Run:
    """Trials of one scene with one noise and one seed."""

    scene: str
    sigma: float
    seed: int = 0
    trials: int = 400
    spp: int = 256

    def validation(self) -> Validation:
        """Their errors beside the bound; runs those that the folder does not hold."""
        name = SCENES[self.scene]
        folder = HERE / "trials"
        folder.mkdir(exist_ok=True)
        return validate(
            HERE.parents[1] / "scenes" / name / f"{name}.xml",
            trials=self.trials,
            perturb_deg=0.2,
            perturb_trans=0.01,
            sigma=self.sigma,
            workers=None,
            resume=folder / f"{name}_{self.sigma:g}_{self.seed}.json",
            size=(32, 24),
            spp=self.spp,
            seed=self.seed,
            integrator={"type": "direct", "emitter_samples": 4, "bsdf_samples": 0},
        )


CALIBRATION = (
    *(Run("high texture", HIGH_SNR, seed) for seed in range(3)),
    Run("low texture", HIGH_SNR, trials=200, spp=128),
)
TABLE = tuple(Run(scene, 0.01, trials=60) for scene in SCENES)
"""For the empirical rows of table 1, with its noise."""
OTHER_SNR = (
    *TABLE,
    Run("high texture", 0.2, trials=100, spp=128),
    Run("high texture", 0.8, trials=60, spp=128),
    Run("high texture", 2.0, trials=60, spp=64),
    Run("high texture", 6.0, trials=40, spp=64),
)


def axis_values(errors: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Small camera-frame twists (n, 6) as shifts along world axes [cm] and turns about the camera's [deg]."""
    return np.hstack([100.0 * errors[:, :3] @ pose[:3, :3].T, np.degrees(errors[:, 3:])])


def statistics(found: Consistency) -> list[tuple[str, float, float, float, float]]:
    """Name, expected value, found value and band of everything that is judged."""
    coverages = [(f"coverage {c.nominal:.0%}", c.nominal, c.empirical, c.low, c.high) for c in found.coverage]
    pairs = enumerate(zip(found.generalized_eigenvalues, found.wishart_band, strict=True), start=1)
    ratios = [(f"variance ratio {k}", 1.0, float(value), *map(float, band)) for k, (value, band) in pairs]
    return [("NEES", 6.0, found.nees, *found.nees_band), *ratios, *coverages]


def rows(run: Run, result: Validation) -> list[dict[str, object]]:
    """A line of the CSV per statistic, with both confidences' bands, for the bound of σ and of σ / 2."""
    lines = []
    for halved in (False, True):
        F = result.bound.information
        F = dataclasses.replace(F, matrix=4.0 * F.matrix) if halved else F
        both = [statistics(consistency(result.errors, F, confidence=level)) for level in CONFIDENCES]
        for narrow, wide in zip(*both, strict=True):
            name, expected, found, *_ = narrow
            line: dict[str, object] = {
                "scene": run.scene,
                "sigma": run.sigma,
                "bound of sigma": run.sigma / (2.0 if halved else 1.0),
                "seed": run.seed,
                "trials": len(result.trials),
                "failed": len(result.failed),
                "excess": f"{result.excess:.3g}",
                "statistic": name,
                "expected": expected,
                "found": f"{found:.4g}",
            }
            for level, (*_, low, high) in zip(CONFIDENCES, (narrow, wide), strict=True):
                inside = low <= (expected if name.startswith("coverage") else found) <= high
                line |= {f"low {level:.1%}": f"{low:.4g}", f"high {level:.1%}": f"{high:.4g}"}
                line |= {f"inside {level:.1%}": "yes" if inside else "no"}
            lines.append(line)
    return lines


def directions(run: Run, result: Validation) -> list[dict[str, object]]:
    """The generalised eigenvectors: one standard deviation of the bound along each, by axes."""
    found = result.consistency
    values = axis_values(found.directions, result.bound.information.pose)
    # Squares add up to the bound's variance of each axis; the largest share is made positive.
    shares = values / np.linalg.norm(values, axis=0)
    signs = np.sign(shares[range(6), np.abs(shares).argmax(axis=1)])[:, None]
    return [
        {
            "scene": run.scene,
            "sigma": run.sigma,
            "seed": run.seed,
            "variance ratio": f"{ratio:.4g}",
            "low 95%": f"{band[0]:.4g}",
            "high 95%": f"{band[1]:.4g}",
            "direction": words(share),
            **{f"{name} [{unit}]": f"{v:.4g}" for name, unit, v in zip(AXES, UNITS, value, strict=True)},
        }
        for ratio, band, share, value in zip(
            found.generalized_eigenvalues, found.wishart_band, shares * signs, values * signs, strict=True
        )
    ]


def words(share: np.ndarray) -> str:
    """The axes that a direction carries most of, the largest first, at least one."""
    order = np.argsort(-np.abs(share))
    named = [i for i in order if share[i] ** 2 > NAMED_SHARE] or order[:1]
    return " ".join(f"{'+' if share[i] > 0.0 else '-'}{AXES[i]}" for i in named)


def draw(results: dict[Run, Validation]) -> Figure:
    """Coverage, ratios of variances by direction, and the mean square error against the noise."""
    figure = Figure(figsize=(14.0, 4.8), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    coverage, ratios, snr = figure.subplots(1, 3)
    for run in CALIBRATION:
        draw_run(coverage, run, results[run])
    coverage.set_title(f"coverage at σ = {HIGH_SNR:g}, with 95 % Wilson intervals", loc="left", fontsize=10)
    coverage.legend(fontsize=8, frameon=False)
    draw_ratios(ratios, {run: results[run] for run in CALIBRATION if run.seed == 0})
    draw_noise(snr, {run: result for run, result in results.items() if run.scene == "high texture"})
    return figure


def draw_run(ax: Axes, run: Run, result: Validation) -> None:
    """Coverage of one run; seeds beside each other."""
    label = f"{run.scene}, {run.trials} trials a seed" if run.seed == 0 else None
    draw_calibration(ax, result.squares, color=COLOURS[run.scene], label=label)
    shift = 0.006 * (run.seed - 1 if run.scene == "high texture" else 2)
    for c in result.consistency.coverage:
        ax.plot([c.nominal + shift] * 2, [c.low, c.high], color=COLOURS[run.scene], lw=2.5, alpha=0.5)


def draw_ratios(ax: Axes, results: dict[Run, Validation]) -> None:
    """Generalised eigenvalues with their 95 % bands, each named by the axes it carries."""
    ax.axhline(1.0, color="black", lw=1, ls="--")
    for k, (run, result) in enumerate(results.items()):
        found, colour = result.consistency, COLOURS[run.scene]
        place = np.arange(6) + 0.36 * k - 0.18
        ax.vlines(place, *found.wishart_band.T, color=colour, lw=9, alpha=0.25)
        ax.plot(place, found.generalized_eigenvalues, "o", color=colour, label=run.scene)
        for x, top, line in zip(place, found.wishart_band[:, 1], directions(run, result), strict=True):
            ax.text(x, top + 0.03, line["direction"], rotation=90, fontsize=8, ha="center", va="bottom")
    ax.set(ylim=(0.5, 1.9), xlabel="direction, from the worst", ylabel="variance / bound")
    ax.set_xticks(range(6), [str(k) for k in range(1, 7)])
    ax.set_title(f"variance over bound at σ = {HIGH_SNR:g}, with 95 % bands", loc="left", fontsize=10)
    ax.legend(fontsize=8, frameon=False, loc="upper right")


def draw_noise(ax: Axes, results: dict[Run, Validation]) -> None:
    """NEES against the sensor's noise, with its 95 % band."""
    ax.axhline(6.0, color="black", lw=1, ls="--")
    for run, result in results.items():
        found = result.consistency
        low, high = found.nees_band
        x = run.sigma * 1.06 ** (run.seed - 1 if run.sigma == HIGH_SNR else 0)
        ax.vlines(x, low, high, color=COLOURS[run.scene], lw=7, alpha=0.25)
        ax.plot(x, found.nees, "o", color=COLOURS[run.scene])
        ax.plot(x, found.nees / (1.0 + result.excess), "_", color="black", ms=9)
        if result.failed:
            ax.text(
                x, high, f"{len(result.failed) / run.trials:.0%} lost", fontsize=8, ha="center", va="bottom"
            )
    ax.plot([], [], "o", color=COLOURS["high texture"], label="mean; bar: 95 % band if the bound is attained")
    ax.plot([], [], "_", color="black", ms=9, label="without the renderer's noise")
    ax.set(xscale="log", xlim=(0.007, 12.0), xlabel="σ [radiance]", ylabel="NEES, mean of ξᵀFξ")
    ax.set_title("high texture: departure from the bound at low SNR", loc="left", fontsize=10)
    ax.legend(fontsize=8, frameon=False, loc="upper left")


def write(path: Path, lines: list[dict[str, object]]) -> None:
    """Lines as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, lines[0].keys())
        writer.writeheader()
        writer.writerows(lines)


def main() -> None:
    """Run the trials, write CSV and figure, print the verdicts."""
    results = {run: run.validation() for run in (*CALIBRATION, *OTHER_SNR)}
    write(HERE / "calibration.csv", [line for run, result in results.items() for line in rows(run, result)])
    write(
        HERE / "directions.csv",
        [line for run, result in results.items() for line in directions(run, result)],
    )
    draw(results).savefig(HERE / "calibration.png", dpi=110)
    for run, result in results.items():
        found = result.consistency
        print(f"{run}: NEES {found.nees:.3f}, excess {result.excess:.1%}, {len(result.failed)} failed")


if __name__ == "__main__":
    main()

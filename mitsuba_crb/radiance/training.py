"""Training a field on a capture: so many minutes, or steps, of descent; kept in a file as it goes.

Random numbers belong to (seed, step), so that a run that was stopped goes on as if it had not been. Its
arithmetic is the same only up to the order in which threads add to the grid: on one thread, bit for bit.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..datasets.photographs import Capture
from ..errors import FieldError, OptionError
from ..files import changes
from ..render.arrays import upload
from ..render.backend import use_mitsuba
from .descent import Moments, descend
from .exploration import Exploration
from .field_file import Arrays, Standing, load_standing, save_field
from .hashgrid import HashGrid, matter_of
from .march import Matter
from .network import Design, Network, new_weights
from .occupancy import Cells
from .photograph_rays import Pool, pools

Floats = NDArray[np.float64]

SAMPLES = 2**17
"""Places evaluated in a step, about."""
_RATES = {"entries": 2e-2, "weights": 5e-3}
"""Of descent, at the beginning."""
_FALL = 0.03
"""What remains of them at the end."""
_WARM = 200
"""Steps before anything is taken to be empty, of fewer places each."""
_WARM_SHARE = 0.5
_EVERY = 32
"""Steps between looks at the occupancy."""
_SLOTS = 2**22
"""Most places of a step, kept or not."""
_FINEST = 0.75
"""Cells of the finest level per pixel."""
_CHECKPOINT_S = 30.0
_MOMENTS = ("first", "second")
_TRACKED = 4096
"""Pixels of held-out photographs that are looked at while training goes on."""


@dataclass(frozen=True)
class Progress:
    """How far training is."""

    step: int
    fraction: float
    """Of the minutes or steps."""
    seconds: float
    """Of all runs together."""
    train_psnr: float
    """[dB] of the last steps' rays."""
    held_out_psnr: float
    """[dB] of some held-out pixels, when last looked at; NaN before, and if nothing is held out."""

    @property
    def words(self) -> str:
        """PSNR, of what is known."""
        held = "" if np.isnan(self.held_out_psnr) else f", held out {self.held_out_psnr:.2f} dB"
        return f"training {self.train_psnr:.2f} dB{held}"


@dataclass(frozen=True, eq=False)
class Trained:
    """A field, and how it compares with photographs that it has not seen."""

    field: HashGrid
    held_out: tuple[tuple[str, float], ...]
    """Name and PSNR [dB] of each held-out photograph."""
    curve: tuple[tuple[int, float, float, float], ...]
    """Step, seconds, processor seconds, and PSNR of some held-out pixels [dB], as training went on."""

    @property
    def psnr(self) -> float:
        """Mean over the held-out photographs [dB]; NaN if there are none."""
        return float(np.mean([value for _, value in self.held_out])) if self.held_out else float("nan")


def train_field(
    capture: Capture,
    out: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    minutes: float = 15.0,
    steps: int | None = None,
    seed: int = 0,
    design: Design | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Trained:
    """Train a field on a capture's photographs, and keep it in a file.

    What the file holds of an earlier run with the same capture and settings is gone on with; the minutes, or
    steps, are of all runs together.

    Args:
        capture: as `load_capture` returned it.
        out: the file, `.npz`.
        size: of all photographs [pixel]; default: halved until no side is longer than 480.
        minutes: of training.
        steps: of descent, in place of minutes: then the same seed gives the same field, but for rounding.
        design: sizes of the field's parts; default: those that suit the photographs.

    Raises:
        CaptureError: there is nothing to train on, or an image cannot be read.
        CameraError: an image is of another shape than the size.
        FieldError: the file is of another capture, other settings, another version, or damaged.
        OptionError: minutes or steps are not positive.
        OutputError: the file cannot be written.
    """
    if not minutes > 0.0 or not np.isfinite(minutes):
        raise OptionError(f"training takes a positive number of minutes, not {minutes:g}")
    if steps is not None and steps < 1:
        raise OptionError(f"training takes at least one step, not {steps}")
    use_mitsuba()
    train, held = pools(capture, size)
    design = design or _design_for(train)
    settings = {
        "photographs": len(capture),
        "capture": train.digest,
        "held out": held.digest if held is not None else "nothing",
        "size": "{}x{}".format(*train.viewpoints[0].intrinsics.size),
        "seed": seed,
        "design": asdict(design),
    }
    run = _Run(Path(out), train, held, settings, design, seed)
    run.go_on(60.0 * minutes if steps is None else np.inf, steps, on_progress)
    return run.result()


def _design_for(pool: Pool) -> Design:
    """One whose finest cells are about as large as what a pixel sees of the centre."""
    focal = float(np.median([np.mean(viewpoint.intrinsics.focal) for viewpoint in pool.viewpoints]))
    positions = np.array([viewpoint.pose[:3, 3] for viewpoint in pool.viewpoints])
    distance = float(np.median(np.linalg.norm(pool.space.normalised(positions), axis=1)))
    across = 4.0 * focal / max(distance, 1e-3)  # such pixels along a side of the cube
    return Design(finest=int(np.clip(_FINEST * across, 64, 4096)))


class _Run:
    """A field while it is trained."""

    def __init__(
        self,
        path: Path,
        train: Pool,
        held: Pool | None,
        settings: dict[str, Any],
        design: Design,
        seed: int,
    ) -> None:
        """Where an earlier run has stopped, or anew."""
        import mitsuba as mi

        self.path, self.train, self.held, self.settings = path, train, held, settings
        self.design, self.seed = design, seed
        self.step, self.rays, self.seconds, self.cpu, self.curve = 0, 256, 0.0, 0.0, []
        self.explored = Exploration(self.design.cells, train.space, train.viewpoints)
        self.encoding = self.design.encoding(self.seed)
        weights, self.vertices = new_weights(self.design, self.seed), self.explored.seen
        arrays: Arrays = {}
        if os.path.lexists(path):
            earlier, standing = load_standing(path)
            changed = changes(standing.settings, settings)
            if changed:
                raise FieldError(
                    f"{path} holds a field trained with {', '.join(changed)}; name another file, or give the "
                    "same capture and settings to go on"
                )
            progress, arrays = standing.progress, standing.arrays
            self.step, self.rays = int(progress["step"]), int(progress["rays"])
            self.seconds, self.cpu = float(progress["seconds"]), float(progress["cpu"])
            self.curve = [tuple(row) for row in progress["curve"]]
            self.encoding.set_params(upload(mi.Float, earlier.entries))
            weights, self.vertices = earlier.weights, earlier.vertices
            self.explored.recall(earlier.vertices)
        self.network = Network(self.design, self.encoding, weights)
        self.moments = {
            "entries": Moments.zero(self.encoding.n_params),
            "weights": Moments.zero(dr.width(self.network.packed)),
        }
        if arrays:
            self.explored.thickness = arrays["thickness"]
            for name, moments in self.moments.items():
                moments.first, moments.second = (upload(mi.Float, arrays[f"{name}_{k}"]) for k in _MOMENTS)

    def go_on(
        self, seconds: float, steps: int | None, on_progress: Callable[[Progress], None] | None
    ) -> None:
        """Until so much time is used, or so many steps are done."""
        started, cpu, earlier, earlier_cpu = time.monotonic(), time.process_time(), self.seconds, self.cpu
        written, errors, psnr = started, [], float("nan")
        matter = self._matter()
        fraction = self._fraction(seconds, steps)
        while fraction < 1.0:
            rng = np.random.default_rng((self.seed, 2, self.step))
            if self.step >= _WARM and (self.step - _WARM) % _EVERY == 0:
                self.vertices = self.explored.look(self.network, rng)
                matter = self._matter()
            errors.append(self._descend(matter, rng, fraction))
            self.step += 1
            now = time.monotonic()
            self.seconds, self.cpu = earlier + now - started, earlier_cpu + time.process_time() - cpu
            fraction = self._fraction(seconds, steps)
            if now - written > _CHECKPOINT_S or fraction >= 1.0:
                psnr = self._tracked()
                self.curve.append((self.step, round(self.seconds, 1), round(self.cpu, 1), round(psnr, 3)))
                self._write(finished=fraction >= 1.0)
                written = time.monotonic()
            if on_progress is not None:
                recent = _psnr(float(np.mean(errors[-50:])))
                on_progress(Progress(self.step, min(fraction, 1.0), self.seconds, recent, psnr))

    def result(self) -> Trained:
        """What has become of it, beside the photographs that are held out."""
        found = self._field()
        errors = _held_out(found, self.held) if self.held else ()
        return Trained(
            found, tuple((name, _psnr(float(error.mean()))) for name, error in errors), tuple(self.curve)
        )

    def _fraction(self, seconds: float, steps: int | None) -> float:
        return self.seconds / seconds if steps is None else self.step / steps

    def _matter(self) -> Matter:
        return matter_of(self.design, self.network, Cells(self.vertices))

    def _descend(self, matter: Matter, rng: np.random.Generator, fraction: float) -> float:
        rays = self.train.draw(rng, self.rays)
        late = self.design.ratio() ** (rng.random(self.rays) - 0.5)
        backgrounds = rng.random((self.rays, 3))
        room = min(self.design.steps, _SLOTS // self.rays)
        outcome = descend(matter, rays, late.astype(np.float32), backgrounds.astype(np.float32), room)
        values = {"entries": self.encoding.data, "weights": self.network.packed}
        for name, value in values.items():
            rate = _RATES[name] * _FALL**fraction
            value[:] = self.moments[name].stepped(value, getattr(outcome, name), rate, self.step + 1)
        dr.eval(values, self.moments)
        per_ray = max(1.0, outcome.samples / self.rays)
        wanted = int(SAMPLES * (_WARM_SHARE if self.step < _WARM else 1.0) / per_ray)
        self.rays = int(np.clip(wanted, self.rays // 2, 2 * self.rays)) // 64 * 64
        self.rays = int(np.clip(self.rays, 64, 65536))
        return outcome.error

    def _field(self) -> HashGrid:
        pools = [self.train] + ([self.held] if self.held else [])
        viewpoints = [viewpoint for pool in pools for viewpoint in pool.viewpoints]
        return HashGrid(
            str(self.path),
            self.design,
            self.train.space,
            np.array(self.encoding.data),
            self.network.weights(),
            self.vertices,
            (0.0,) * 3 if self.train.opaque else (1.0,) * 3,
            tuple(sorted(viewpoints, key=lambda viewpoint: viewpoint.name)),
            {"steps": self.step, "seconds": round(self.seconds, 1), **self.settings},
        )

    def _tracked(self) -> float:
        """PSNR of some pixels that are held out."""
        if self.held is None:
            return float("nan")
        stride = max(1, len(self.held.usable) // _TRACKED)
        errors = [error for _, error in _held_out(self._field(), self.held, stride)]
        return _psnr(float(np.concatenate(errors).mean()))

    def _write(self, *, finished: bool) -> None:
        """Keep all of it; what only training needs, three quarters, no longer than until it is finished."""
        arrays = {} if finished else {"thickness": self.explored.thickness}
        for name, moments in () if finished else self.moments.items():
            arrays |= {f"{name}_{which}": np.array(getattr(moments, which)) for which in _MOMENTS}
        progress = {
            "step": self.step,
            "rays": self.rays,
            "seconds": self.seconds,
            "cpu": self.cpu,
            "curve": [list(row) for row in self.curve],
        }
        save_field(self.path, self._field(), Standing(self.settings, progress, arrays))


def _held_out(found: HashGrid, pool: Pool, stride: int = 1) -> Iterator[tuple[str, Floats]]:
    """Of each photograph its name, and squared differences (n,) of its pixels, or of one in so many."""
    background = np.asarray(found.background)
    for k, viewpoint in enumerate(pool.viewpoints):
        first, last = np.searchsorted(pool.usable, pool.starts[k : k + 2])
        index = pool.usable[first:last:stride]
        down, across = np.divmod(index - pool.starts[k], viewpoint.intrinsics.size[0])
        pixels = np.stack([across, down], axis=1)
        if not len(pixels):
            continue
        shown = found.show(Camera.of(viewpoint.intrinsics), viewpoint.pose, pixels).values
        colours = pool.values[index] / 255.0
        wanted = colours[:, 3:] * colours[:, :3] + (1.0 - colours[:, 3:]) * background
        yield viewpoint.name, ((shown - wanted) ** 2).mean(axis=1)


def _psnr(error: float) -> float:
    """Of a mean squared difference of values from 0 to 1 [dB]."""
    return float(-10.0 * np.log10(max(error, 1e-12)))

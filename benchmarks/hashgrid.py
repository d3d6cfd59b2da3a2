"""What a hash grid learns of the fox in how long, what its columns cost, and whether they are right.

    python benchmarks/hashgrid.py fox [FIELD.npz] [MINUTES]   PSNR of held-out photographs against time
    python benchmarks/hashgrid.py cost FIELD.npz              six columns beside the image
    python benchmarks/hashgrid.py columns FIELD.npz           them beside differences, the film, more places

`fox` trains at 135x240 into FIELD.npz (default: fox.npz here), or goes on with what is there; its capture is
../shared/data/multiview/fox_270x480.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path

import numpy as np

from mitsuba_crb import load_capture, se3
from mitsuba_crb.camera import Camera
from mitsuba_crb.radiance.field_file import load_field
from mitsuba_crb.radiance.hashgrid import HashGrid
from mitsuba_crb.radiance.training import train_field
from mitsuba_crb.render.backend import use_mitsuba

FOX = Path(__file__).parents[2] / "shared" / "data" / "multiview" / "fox_270x480"
SIZE = (135, 240)


def fox(out: str = "fox.npz", minutes: str = "15") -> None:
    """Training, and the curve."""
    trained = train_field(load_capture(FOX), out, size=SIZE, minutes=float(minutes))
    print("  step    wall s    cpu s   held-out PSNR [dB]")
    for step, wall, cpu, psnr in trained.curve:
        print(f"{step:6d} {wall:9.1f} {cpu:8.1f} {psnr:8.2f}")
    for name, psnr in trained.held_out:
        print(f"{name:20s} {psnr:6.2f}")
    print(f"mean over {len(trained.held_out)} held-out photographs: {trained.psnr:.2f} dB")


def view(field: HashGrid, k: int) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Camera, pose and all pixels of one of its viewpoints."""
    viewpoint = field.viewpoints[k]
    width, height = viewpoint.intrinsics.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    return Camera.of(viewpoint.intrinsics), viewpoint.pose, pixels


def cost(file: str) -> None:
    """Warm times of the image and of its columns."""
    field = load_field(file)
    camera, pose, pixels = view(field, len(field.viewpoints) // 2)
    times = {}
    for name, call in (("image", field.show), ("image and columns", field.columns)):
        call(camera, pose, pixels)
        took = []
        for _ in range(5):
            wall, cpu = time.perf_counter(), time.process_time()
            call(camera, pose, pixels)
            took.append((time.process_time() - cpu, time.perf_counter() - wall))
        times[name] = min(took)
        print(
            f"{name:18s} {len(pixels)} pixels: {times[name][1]:.3f} s, {times[name][0]:.3f} s of processors"
        )
    image, columns = times.values()
    print(f"ratio: {columns[1] / image[1]:.2f} by wall clock, {columns[0] / image[0]:.2f} by processor time")


def columns(file: str) -> None:
    """Slopes and correlations against central differences, of some views and steps; twice as many places."""
    field = load_field(file)
    finer = dataclasses.replace(field, design=dataclasses.replace(field.design, steps=2 * field.design.steps))
    for k in np.linspace(0, len(field.viewpoints) - 1, 3).astype(int):
        camera, pose, pixels = view(field, k)
        shown = field.show(camera, pose, pixels)
        depth = float(np.nanmedian(shown.depth))
        found = field.columns(camera, pose, pixels)[1]
        print(f"{field.viewpoints[k].name}: median depth {depth:.3g}")
        for motion in (0.03, 0.01, 0.003):
            angles = camera.angles(motion)
            steps = np.concatenate([angles[:2] * depth, [angles[0] * depth], angles])
            words = []
            for j in range(6):
                twist = steps[j] * np.eye(6)[j]
                ahead, back = (field.show(camera, pose @ se3.exp(s * twist), pixels).values for s in (1, -1))
                wanted = (ahead - back) / (2.0 * steps[j])
                a, b = found[..., j].ravel(), wanted.ravel()
                words.append(f"{a @ b / (a @ a):.4f} ({np.corrcoef(a, b)[0, 1]:.5f})")
            print(f"  step {motion:5.3f} pixel: slope (correlation) {'  '.join(words)}")
        film, step = pixels + 0.5, 0.01
        gradient = np.stack(
            [
                (
                    field.at(camera, pose, film + step * axis).values
                    - field.at(camera, pose, film - step * axis).values
                )
                / (2.0 * step)
                for axis in np.eye(2)
            ],
            axis=-1,
        )
        flow = camera.flow(camera.directions(film))[:, :, 3:]
        along = -np.einsum("ncf,nfk->nck", gradient, flow)
        turned = found[..., 3:]
        ratios = (turned * along).sum(axis=(0, 1)) / (turned**2).sum(axis=(0, 1))
        print("  rotation columns: slope of the image's flow along the film", np.round(ratios, 4))
        two = field.columns(camera, pose, pixels, order=1)[1]
        more = finer.columns(camera, pose, pixels)[1]
        F, other, better = (np.einsum("nci,ncj->ij", J, J) for J in (found, two, more))
        print(f"  orders of summation: F differs by {relative(F, other)} of √(F_ii F_jj)")
        print("  F_ii with twice as many places, over F_ii:", np.round(np.diag(better) / np.diag(F), 4))


def relative(F: np.ndarray, other: np.ndarray) -> str:
    """The largest difference of entries, over √(F_ii F_jj)."""
    scale = np.sqrt(np.diag(F))
    return f"{np.abs((other - F) / np.outer(scale, scale)).max():.2g}"


if __name__ == "__main__":
    use_mitsuba()
    {"fox": fox, "cost": cost, "columns": columns}[sys.argv[1]](*sys.argv[2:])

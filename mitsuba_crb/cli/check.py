"""`mitsuba-crb check`: the methods beside finite differences."""

from __future__ import annotations

from typing import Annotated

import typer

from ..measure.options import CHECKING, MeasurementOptions
from .options import (
    Batches,
    Camera,
    Channels,
    Debug,
    Define,
    DepthEdges,
    DepthRange,
    DropInvalid,
    Integrator,
    Light,
    Measure,
    Pixels,
    Pose,
    Scene,
    Seed,
    Sensor,
    Size,
    Spp,
    Up,
    Variant,
)
from .outcome import console, foreseen, measuring


def check(
    scene: Scene,
    sensor: Sensor = "0",
    pose: Pose = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            metavar="M",
            help="Method to check, repeatable: flow, as bound uses it, or forward; of fields exact. Default: "
            "as bound.",
        ),
    ] = None,
    spp: Spp = None,
    max_spp: Annotated[
        int | None,
        typer.Option(
            "--max-spp", metavar="N", help="Most paths per pixel; default: 256, or more of a small image."
        ),
    ] = None,
    seed: Seed = MeasurementOptions.seed,
    batches: Batches = CHECKING["batches"],
    size: Size = None,
    camera: Camera = None,
    define: Define = None,
    light: Light = None,
    up: Up = None,
    channels: Channels = None,
    measure: Measure = MeasurementOptions.measure,
    depth_range: DepthRange = None,
    depth_edges: DepthEdges = False,
    pixels: Pixels = None,
    drop_invalid: DropInvalid = False,
    integrator: Integrator = None,
    variant: Variant = None,
    debug: Debug = False,
) -> int:
    """Is the derivative right on this scene?

    Compares a method with finite differences, by as many paths as it takes to tell. Exit code 0 if they
    agree, 1 if they disagree, 3 if those that are allowed cannot tell.
    """
    with foreseen(debug, variant):
        from ..measure.sensing import parse_range
        from .arguments import scene_defines, view_options

        options = view_options(
            sensor=sensor,
            pose=pose,
            size=size,
            camera=camera,
            pixels=pixels,
            drop_invalid=drop_invalid,
            integrator=integrator,
            spp=spp,
            max_spp=max_spp,
            seed=seed,
            batches=batches,
        )
        options |= {"channels": channels, "measure": measure}
        options |= {"depth_range": parse_range(depth_range), "depth_edges": depth_edges}
        defines = scene_defines(scene, define, light, up)

        from ..measure.check import check_jacobian
        from ..render.scene import SceneFile
        from ..show.check_table import print_check

        with measuring() as (_, warned):
            result = check_jacobian(
                SceneFile(scene, defines), methods=tuple(method) if method else None, **options
            )
        print_check(console(), result, warned)
        return result.exit_code

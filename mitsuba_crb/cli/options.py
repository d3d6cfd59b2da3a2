"""Arguments and options that several commands have, with their words of help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

Scene = Annotated[
    Path,
    typer.Argument(
        metavar="SCENE",
        help="A Mitsuba 3 scene file (.xml), a world's (.glb, .gltf, .obj, .ply, .stl), or a radiance "
        "field's: Gaussian splats (.ply, .splat) or a trained field (.npz). Or a scene that comes along: "
        "demo:textured_room, demo:boxes and others.",
    ),
]
Light = Annotated[
    str | None,
    typer.Option(
        metavar="constant:L|sky|FILE.exr|baked|none",
        help="Light of a world, besides lamps in its file; baked: its colours are the radiance, as in scans. "
        "Default: constant:1 of files without lamps.",
    ),
]
Up = Annotated[
    str | None,
    typer.Option(metavar="AXIS", help="Where the sky of a world is: x, y, z, -x, -y or -z; glTF's is y."),
]
Sensor = Annotated[str, typer.Option(metavar="S", help="The camera: index or id.")]
Pose = Annotated[
    str | None,
    typer.Option(
        metavar='FILE|"x y z qx qy qz qw"',
        help="world_from_camera in place of the scene's: a file with a 4x4 matrix (text, .npy or .json), "
        "or position and quaternion.",
    ),
]
Camera = Annotated[
    str | None,
    typer.Option(
        metavar="FILE[:NAME]|scene",
        help="A calibration in place of the scene's camera: of COLMAP, transforms.json, LLFF, ROS, Kalibr, "
        "OpenCV, or TOML; NAME is one of several cameras in it. Default with --poses: what their file says, "
        "of each pose its own, if it does; scene: the scene's nevertheless.",
    ),
]
Poses = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Many poses, a row of the table each: TUM, KITTI, EuRoC, COLMAP, transforms.json, LLFF, "
        "7-Scenes, .npy (N,4,4) and others, told apart by what is in them; or a capture's folder.",
    ),
]
Convention = Annotated[
    str | None,
    typer.Option(
        metavar="C",
        help='Of --poses, where the file cannot tell: such as "opencv camera_from_world"; see '
        "`mitsuba_crb.datasets.poses`.",
    ),
]
BodyFromCamera = Annotated[
    str | None,
    typer.Option(
        metavar='FILE|"x y z qx qy qz qw"',
        help="Of poses that are a body's: where it carries its camera, by EuRoC's sensor.yaml (T_BS), a 4x4 "
        "matrix (text, .npy or .json), or position and quaternion; the camera's axes are OpenCV's, unless "
        "--convention says otherwise.",
    ),
]
Images = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        help="Photographs taken at --poses, which the render is compared with; default: those beside their "
        "file.",
    ),
]
Photographs = Annotated[
    Path | None,
    typer.Option(
        metavar="CAPTURE",
        help="A capture in the scene's frame, whose held-out photographs say what the map does not explain: "
        "the noise, if none is given, and the misspecified covariance beside the ideal bound.",
    ),
]
PhotoEncoding = Annotated[
    Literal["srgb", "linear"],
    typer.Option("--photo-encoding", help="What the values of photographs are."),
]
CsvFile = Annotated[
    Path | None,
    typer.Option(
        "--csv", metavar="FILE", help="Of --poses: write a row as each is done; resumes what is there."
    ),
]
ParquetFile = Annotated[
    Path | None,
    typer.Option("--parquet", metavar="FILE", help="Of --poses: write the same table as Parquet."),
]
Method = Annotated[
    str | None,
    typer.Option(
        metavar="M",
        help="How the Jacobian is measured: flow (the default of scenes), forward or finite_difference; of "
        "fields exact (their default) or finite_difference.",
    ),
]
Spp = Annotated[
    int | None,
    typer.Option(metavar="N", help="Paths of every pixel, over all batches, in place of a precision."),
]
Precision = Annotated[
    float | None,
    typer.Option(
        metavar="P",
        help="Relative standard error that every standard deviation should have; paths go where they are "
        "needed. Default: 0.05.",
    ),
]
MaxSpp = Annotated[
    int | None,
    typer.Option(
        "--max-spp",
        metavar="N",
        help="Most paths per pixel, on average; default: 67 million in all.",
    ),
]
Seed = Annotated[int, typer.Option(metavar="N", help="Of all random numbers; same seed, same bits.")]
Batches = Annotated[int, typer.Option(metavar="N", help="Independent estimates, at least 4.")]
Sigma = Annotated[
    float | None,
    typer.Option(
        metavar="X",
        help="Standard deviation of the pixel noise (radiance), of a camera that never saturates; default: "
        "0.01 of white.",
    ),
]
Exposure = Annotated[
    str | None,
    typer.Option(
        metavar="X|auto",
        help="White of the default noise (radiance); default: from what is lit, once for all views of a run; "
        "auto: for each.",
    ),
]
NoClip = Annotated[
    bool, typer.Option("--no-clip", help="The default noise goes on above white instead of saturating.")
]
NoiseFile = Annotated[
    Path | None,
    typer.Option(
        "--noise",
        metavar="FILE.toml",
        help="Noise model and sensor response: a table [noise], see `mitsuba_crb.noise.schema`.",
    ),
]
Marginalize = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="A parameter that is not known either: gain, black, gain:32 (one in every 32x32 tile), fov, "
        "principal_point, fx, fy, cx, cy, a coefficient of the camera's lens such as k1, of "
        "splats all colours or opacities, or a scene parameter's name in mi.traverse; repeatable.",
    ),
]
Prior = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="What is known of the pose beforehand (.toml, .json): a frame, and information, covariance, "
        "or position_std and rotation_std_deg.",
    ),
]
Channels = Annotated[
    str | None,
    typer.Option(
        metavar="C",
        help="What a camera of colour measures: rgb, luminance, red, green or blue; default: as the film.",
    ),
]
Measure = Annotated[
    str, typer.Option(metavar="M", help="What is measured: colour, depth, or rgbd, which is both.")
]
DepthSigma = Annotated[
    str | None,
    typer.Option(
        metavar="X|FILE|stereo:B,S",
        help="Standard deviation of depth (scene unit), a file with depths and standard deviations in two "
        "columns, or stereo's law with baseline B (scene unit) and S of the disparity (pixels); default: "
        "0.01 of the depth.",
    ),
]
DepthRange = Annotated[
    str | None,
    typer.Option("--range", metavar="LO:HI", help="Depths that are measured (scene unit); default: all."),
]
DepthEdges = Annotated[
    bool,
    typer.Option(
        "--depth-edges", help="Measure depth where one surface ends in front of another within a pixel, too."
    ),
]
Size = Annotated[str | None, typer.Option(metavar="WxH", help="Image size in place of the film's (pixels).")]
Pixels = Annotated[
    str | None,
    typer.Option(metavar="random:F|gradient:F|MASK.png", help="Which pixels to measure; default: all."),
]
DropInvalid = Annotated[
    bool, typer.Option("--drop-invalid", help="Leave out pixels with NaN or infinite radiance.")
]
Define = Annotated[
    list[str] | None,
    typer.Option(
        "-D",
        metavar="name=value",
        help="Set one of the scene's <default>s; of splats variant (classic, antialiased or mip, as trained) "
        "or background (a grey, or R,G,B); repeatable.",
    ),
]
Config = Annotated[
    Path,
    typer.Argument(
        metavar="CONFIG.toml",
        help="Who looks where: see scenes/warehouse/warehouse.toml, or try demo:warehouse.",
    ),
]
Workers = Annotated[
    int | None, typer.Option(metavar="N", help="Processes that render; default: one per agent and core.")
]
Store = Annotated[
    Path, typer.Argument(metavar="STORE.zarr", help="A field of views, as `mitsuba-crb field` writes it.")
]
PlanPlot = Annotated[
    Path | None,
    typer.Option(
        "--plot", metavar="FILE.png", help="Write a plan of the field with the answer, seen from above."
    ),
]
JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write everything as JSON.")]
Report = Annotated[
    Path | None,
    typer.Option(
        "--report",
        metavar="FILE.html",
        help="Write a page to look at in a browser: tables, pictures with values, the cameras in the world; "
        "needs mitsuba_crb[report].",
    ),
]
Integrator = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Integrator in place of the scene's, such as path, direct or volpath."),
]
Variant = Annotated[
    Literal["llvm_ad_rgb", "cuda_ad_rgb"] | None,
    typer.Option(help="Of Mitsuba: on the processor (the default), or on an NVIDIA GPU (untested)."),
]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]

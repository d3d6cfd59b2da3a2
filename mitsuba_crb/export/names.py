"""What can be said of an export; apart, for the command's help needs nothing else."""

from typing import Literal

FormatName = Literal["gtsam", "colmap", "ros", "g2o", "tum", "csv", "npz", "rerun"]
"""Formats of poses for other tools, see `formats`."""
Axes = Literal["mitsuba", "opencv", "opengl"]
"""Of a camera, see `estimates.AXES`."""

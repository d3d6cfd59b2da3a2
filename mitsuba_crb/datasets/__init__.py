"""What other tools write: poses, intrinsics, captures. NumPy only, in the conventions of `se3`, `camera`."""

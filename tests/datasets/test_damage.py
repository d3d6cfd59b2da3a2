"""Files damaged at random are refused in one line, or read: never a traceback, never a warning."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from camera_files import OPENCV, TEXTS, colmap_binary, written
from pose_files import FILES, some_poses

from mitsuba_crb import load_camera, load_capture, load_poses
from mitsuba_crb.errors import MitsubaCRBError

PIECES = (b"nan", b"-", b"1e999", b"[", b"{", b"#", b"\n", b",", b"0" * 300, b"null", b'"', b"\0", b"\xff")
WHOLE = {
    **{form: write(OPENCV) for form, write in TEXTS.items()},
    "COLMAP's cameras.bin": colmap_binary(OPENCV),
    **{f"poses as {form}": write(some_poses()) for form, write in FILES.items()},
}


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, with a part left out or doubled, or with something else in it."""
    i = int(rng.integers(len(data)))
    j = i + int(rng.integers(1, 40))
    piece = PIECES[rng.integers(len(PIECES))]
    kinds = data[:i], data[:i] + data[j:], data[:j] + data[i:], data[:i] + piece + data[i + 1 :]
    return kinds[rng.integers(4)]


@pytest.mark.parametrize("form", WHOLE)
def test_any_damage_is_refused_in_one_line_or_read(form: str, tmp_path: Path) -> None:
    whole = WHOLE[form]
    data = whole if isinstance(whole, bytes) else whole.encode()
    rng = np.random.default_rng(2)
    lines = []
    for _ in range(25):
        path = written(tmp_path, damaged(data, rng))
        for load in (load_camera, load_poses, load_capture):
            try:
                load(path)
            except MitsubaCRBError as error:
                lines.append(str(error))
    assert len(lines) > 50  # two of three readers are for something else
    assert not [line for line in lines if "\n" in line or len(line) > 600]

"""PSNR of renders against photographs: high at the right poses, low at inverted ones."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from small_scenes import camera, scene, texture, wall

from mitsuba_crb import se3
from mitsuba_crb.errors import CaptureError
from mitsuba_crb.measure.likeness import Likeness, likeness, unlike
from mitsuba_crb.measure.poses import pose_table
from mitsuba_crb.noise import SRGB, Gaussian

pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

POSES = [se3.exp(xi) for xi in ([0.8, 0.3, 0.2, 0.1, 0.25, 0.9], [-0.6, 0.4, 0.1, -0.2, 0.1, -1.1])]
INVERTED = [se3.inverse(pose) for pose in POSES]


def world(pose: Any = None) -> dict[str, Any]:
    """A textured wall from a pose."""
    seen_from = camera()
    if pose is not None:
        seen_from["to_world"] = mi.ScalarTransform4f(pose)
    return scene(wall=wall(texture()), sensor=seen_from)


@pytest.fixture
def photographs(tmp_path: Path) -> list[Path]:
    """Renders at the poses as a camera stores them, with gain and black level of its own."""
    files = []
    for k, pose in enumerate(POSES):
        image = np.array(mi.render(mi.load_dict(world(pose)), spp=64), dtype=np.float64)[:, :, :3]
        stored = np.rint(255.0 * SRGB(np.clip(0.05 + 0.6 * image, 0.0, 1.0))).astype(np.uint8)
        files.append(tmp_path / f"{k}.png")
        Image.fromarray(stored).resize((384, 288), Image.Resampling.NEAREST).save(files[-1])
    return files


def likenesses(poses: Any, photographs: Any, **more: Any) -> list[Likeness]:
    options: dict[str, Any] = {"spp": 8, **more}
    table = pose_table(mi.load_dict(world()), poses, Gaussian(0.02), photographs=photographs, **options)
    return [row.likeness for row in table.rows]


def test_it_is_high_at_the_right_poses_and_low_at_inverted_ones(photographs: list[Path]) -> None:
    said: list[Likeness] = []
    right = likenesses(POSES, photographs, on_likeness=said.extend)
    assert min(right).psnr_db > 30.0
    assert said == right
    assert not unlike(right)
    # Of so little contrast that 18 dB alone would not tell.
    wrong = likenesses(INVERTED, photographs)
    assert max(one.psnr_db - one.even_psnr_db for one in wrong) < 1.0
    assert unlike(wrong)


def test_a_pose_may_have_no_photograph_or_one_of_another_shape(photographs: list[Path]) -> None:
    Image.open(photographs[0]).resize((100, 100)).save(photographs[0])
    assert np.isnan(likenesses(POSES, photographs))[:, 0].tolist() == [True, False]
    assert np.isnan(likenesses(POSES, [None, photographs[1]]))[:, 0].tolist() == [True, False]
    none = likenesses(POSES, None)
    assert np.isnan(none).all()
    assert not unlike(none)
    with pytest.raises(CaptureError, match="2 poses have 1 photographs"):
        likenesses(POSES, photographs[:1])
    photographs[1].write_text("no image")
    with pytest.raises(CaptureError, match="is no image"):
        likenesses(POSES, photographs)


def test_exposure_saturation_and_masks_do_not_count() -> None:
    rng = np.random.default_rng(3)
    image = rng.uniform(0.0, 1.0, size=(20, 30, 3))
    opacity = np.ones((20, 30))
    seen = 0.02 + np.array([0.5, 0.7, 0.3]) * image
    assert likeness(image, seen, opacity).psnr_db > 200.0
    image[:2] *= 50.0  # a lamp
    seen = np.clip(0.02 + 0.5 * image, 0.0, 1.0)
    assert likeness(image, seen, opacity).psnr_db > 200.0
    image[5:8], opacity[5:8] = rng.uniform(0.0, 1.0, size=(3, 30, 3)), 0.0
    assert likeness(image, seen, opacity).psnr_db > 200.0
    assert likeness(image, seen, np.ones((20, 30))).psnr_db < 25.0
    assert math.isnan(likeness(image, seen, 0.0 * opacity).psnr_db)
    image[10:13], seen[14:16] = 0.0, 0.0  # a hole in the scan, and what is black in the photograph alone
    assert likeness(image[:14], seen[:14], opacity[:14]).psnr_db > 200.0
    assert likeness(image, seen, opacity).psnr_db < 25.0
    # ±0.1 about grey, and a render that is even.
    seen = SRGB.inverse(0.5 + 0.1 * np.sign(rng.normal(size=(20, 30, 3))))
    even = likeness(0.0 * image + 0.3, seen, opacity)
    assert even == pytest.approx((20.0, 20.0), abs=0.5)

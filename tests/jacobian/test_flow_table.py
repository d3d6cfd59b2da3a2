"""Flow's information against references: a table of scenes, each with its tolerance (`flow_scenes.ROWS`).

References are by finite differences with many samples, extrapolated in the step (`references/*.json`, made by
benchmarks/reference.py); they share neither formula nor random numbers with flow.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from flow_scenes import OTHERS, ROWS, Row

from mitsuba_crb import pose_bound
from mitsuba_crb.information.fisher import FisherInformation
from mitsuba_crb.noise import Gaussian

REFERENCES = Path(__file__).parent / "references"
OFF_DIAGONAL = 0.02
"""Of √(F_ii F_jj): what matters of an entry that may be zero."""
QUICK = ("nearest", "sphere", "split_box", "rough_conductor", "mirror", "hidden_emitter")


def compared(name: str, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """(F − reference)_ij and its standard error, both over √(F_ii F_jj) of the reference."""
    row = ROWS[name]
    if name.startswith("real_") and not OTHERS.is_dir():
        pytest.skip("needs ../shared/data/mitsuba")
    reference = json.loads((REFERENCES / f"{name}.json").read_text(encoding="utf-8"))
    F = by_flow(row, reference["noise_sigma"], spp)
    matrix = np.array(reference["matrix"])
    root = np.sqrt(np.diag(matrix))
    error = np.hypot(reference["standard_error"], F.standard_error)
    return (F.matrix - matrix) / np.outer(root, root), error / np.outer(root, root)


def without_closure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Takes the numbers of flow alone, whatever its closure says of them."""
    from mitsuba_crb.jacobian import flow

    monkeypatch.setattr(flow, "suspects", lambda *_: np.zeros(len(_[-1].number), dtype=bool))


def by_flow(row: Row, sigma: float, spp: int) -> FisherInformation:
    bound = pose_bound(row.scene(), Gaussian(sigma), spp=spp, batches=16, seed=1, **row.options)
    return bound.information


def assert_close(
    name: str, difference: np.ndarray, error: np.ndarray, tolerance: float, off_diagonal: float = OFF_DIAGONAL
) -> None:
    off = ~np.eye(6, dtype=bool)
    within = np.abs(difference) <= np.where(off, np.maximum(off_diagonal, 3 * error), np.inf)
    assert within.all(), f"{name}, off-diagonals:\n{np.round(difference, 4)}\n± {np.round(error, 4)}"
    ratio, diagonal = np.diag(difference), np.diag(error)
    text = " ".join(f"{1 + r:.4f}±{e:.4f}" for r, e in zip(ratio, diagonal, strict=True))
    assert np.all(np.abs(ratio) <= np.maximum(tolerance, 3 * diagonal)), f"{name}: {text}"


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_information_by_flow_is_the_references(name: str) -> None:
    row = ROWS[name]
    difference, error = compared(name, row.spp)
    assert_close(name, difference, error, row.tolerance)
    assert np.diag(error).max() <= row.error


@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
@pytest.mark.parametrize("name", QUICK)
def test_few_paths_agree_with_the_references_too(name: str) -> None:
    """Within 6 %, or 3 of some 2 % standard errors."""
    assert_close(name, *compared(name, 256), 0.06, 0.06)


@pytest.mark.parametrize("name", [name for name in ROWS if not name.startswith("real_")])
def test_references_belong_to_the_scenes(name: str) -> None:
    reference = json.loads((REFERENCES / f"{name}.json").read_text(encoding="utf-8"))
    assert reference["digest"] == ROWS[name].digest()


@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
@pytest.mark.parametrize("name", ["split_box", "sphere"])
def test_without_the_parallax_term_translation_is_wrong(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: the comparison sees a missing term, and where it is missing."""
    from mitsuba_crb.jacobian import flow

    class Nothing(flow.ParallaxTerm):
        def result(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            rows, terms, closing = super().result()
            return rows[:0], terms[:, :0], closing[..., :0]

    monkeypatch.setattr(flow, "ParallaxTerm", Nothing)
    without_closure(monkeypatch)
    difference, error = (np.diag(matrix) for matrix in compared(name, 512))
    assert np.all(np.abs(difference / error)[[0, 2]] > 6.0)
    assert np.all(np.abs(difference / error)[3:] < 3.0)


@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
@pytest.mark.parametrize("name", ["mirror", "blend"])
def test_without_the_view_term_translation_is_wrong(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from mitsuba_crb.jacobian.view_term import ViewTerm

    monkeypatch.setattr(ViewTerm, "of", staticmethod(lambda *_: None))
    ratio = np.diag(compared(name, 256)[0])
    assert np.abs(ratio[:3]).max() > 0.1
    assert np.all(np.abs(ratio[3:]) < 0.06)


@pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
def test_with_the_contours_of_hidden_emitters_translation_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    from mitsuba_crb.jacobian import silhouettes

    monkeypatch.setattr(silhouettes, "first_hit", lambda view, ray: view.scene.ray_intersect(ray))
    without_closure(monkeypatch)
    ratio = np.diag(compared("hidden_emitter", 2048)[0])
    assert np.abs(ratio[:3]).max() > 0.06
    assert np.all(np.abs(ratio[3:]) < 0.06)

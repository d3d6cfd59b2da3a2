"""The NumPy half of the library imports and works where Mitsuba and Dr.Jit cannot be imported."""

from __future__ import annotations

import subprocess
import sys

BLOCKED = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("mitsuba", "drjit", "matplotlib", "OpenEXR", "typer", "rich"):
            raise ImportError(f"{name} is blocked")

sys.meta_path.insert(0, Blocker())
"""

BOUND = """
import numpy as np
import mitsuba_crb
import importlib
import pkgutil
from mitsuba_crb import camera, errors, files, message, noise, processes, se3

for package in ("noise", "information", "bound", "agents", "datasets"):
    folder = importlib.import_module(f"mitsuba_crb.{package}")
    for module in pkgutil.iter_modules(folder.__path__):
        importlib.import_module(f"mitsuba_crb.{package}.{module.name}")

J = np.random.default_rng(0).normal(size=(4, 64, 3, 6))
J[:] = J[0]
pixels = np.stack(np.divmod(np.arange(64), 8), axis=1)
about = mitsuba_crb.Linearisation(
    variable="camera",
    frame="camera",
    pose=np.eye(4),
    length_scale=1.0,
    selection=mitsuba_crb.PixelSelection("all", 64, 64, "all"),
)
jacobian = mitsuba_crb.ImageJacobian(J, pixels, np.zeros((8, 8, 3)), linearisation=about)
fisher_information = mitsuba_crb.fisher_information(jacobian, mitsuba_crb.noise.Gaussian(0.1))
result = mitsuba_crb.cramer_rao_bound(fisher_information)
assert result.rank == 6, result
agent = mitsuba_crb.Agent("one", fisher_information, np.eye(4))
assert mitsuba_crb.fuse([agent]).bound.rank == 6
received = message.decode(message.encode(fisher_information, agent="one", sequence=0))
assert received.kept > 0.99
assert not {"mitsuba", "drjit"} & {name.partition(".")[0] for name in sys.modules}
"""


def _run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_a_bound_is_computed_without_mitsuba():
    run = _run(BLOCKED + BOUND)
    assert run.returncode == 0, run.stderr


def test_the_block_blocks():
    run = _run(BLOCKED + "import mitsuba")
    assert "mitsuba is blocked" in run.stderr
    assert run.returncode != 0

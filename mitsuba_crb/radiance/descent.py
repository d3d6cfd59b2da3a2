"""One step of training: what a batch of rays shows, how far it is from the photographs, and a step downhill.

    L = mean over rays of |C − photograph|²,   g = ∂L/∂C
    ∂L/∂c_k = w_k g,   ∂L/∂σ_k = Δ_k (T_{k+1} c_k − Σ_{j>k} w_j c_j − T_n bg) · g

First all rays are marched through the field as it is, and each place's T, w and running sum are kept; then
those places are evaluated once more, and what they owe is carried back into the grid and the network.
Every ray has a background of its own, drawn by chance: where a photograph is opaque, so must the field be.

What the network owes is summed over one ray in `_SHARE` only: it has few parameters, many rays, and adding up
its outer products takes longer than all the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..render.arrays import download, upload
from .march import Matter, next_place, sample
from .network import basis
from .photograph_rays import Rays

if TYPE_CHECKING:
    import mitsuba as mi

_SHARE = 8
_DIM = 1e-3
"""Transmittance at which a ray ends here: what is behind is background."""
KEPT = 6
"""Numbers kept of each place: t, T behind it, w, and the colours so far."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a step came to."""

    error: float
    """Mean squared difference of a colour."""
    samples: int
    """Places that were evaluated."""
    entries: Any
    """∂L/∂ entries of the hash grid."""
    weights: Any
    """∂L/∂ weights of the network as packed, over `_SHARE`."""


@dr.syntax  # type: ignore[untyped-decorator]
def _marched(
    matter: Matter, o: mi.Vector3f, d: mi.Vector3f, late: mi.Float, kept: list[Any], room: mi.UInt32
) -> tuple[mi.Color3f, mi.Float, mi.UInt32]:
    """C without a background, T_n, and how many places were kept in the ray's part of `kept`."""
    import mitsuba as mi

    total, through = mi.Color3f(0.0), mi.Float(1.0)
    k, count, active = mi.UInt32(0), mi.UInt32(0), mi.Bool(True)
    first = dr.arange(mi.UInt32, dr.width(late)) * room
    Y, _ = basis(d)
    while dr.hint(active, exclude=[matter, o, d, late, kept, room, first, Y], label="places to learn from"):
        k, active = next_place(matter, o, d, late, k, active)
        t = dr.gather(mi.Float, matter.places, k, active) * late
        here = sample(matter, mi.Vector3f(o + t * d), t * matter.width, Y)
        behind = through * dr.exp(-dr.select(active, here.sigma * here.step, 0.0))
        w = through - behind
        total += w * here.colour
        for target, value in zip(kept, (t, behind, w, total.x, total.y, total.z), strict=True):
            dr.scatter(target, value, first + count, active)
        through = behind
        count += dr.select(active, 1, 0)
        k += 1
        active &= (through > _DIM) & (count < room)
    return total, through, count


def descend(
    matter: Matter,
    rays: Rays,
    late: NDArray[np.float32],
    backgrounds: NDArray[np.float32],
    room: int,
) -> Outcome:
    """The gradient of a batch.

    Args:
        late: (n,) what places along each ray are multiplied by.
        backgrounds: (n, 3).
        room: most places of a ray; what is behind the last is background.
    """
    import mitsuba as mi

    n = len(rays.origins)
    o, d, behind = (_vectors(values) for values in (rays.origins, rays.directions, backgrounds))
    kept = [dr.empty(mi.Float, n * room) for _ in range(KEPT)]
    total, through, count = _marched(matter, o, d, upload(mi.Float, late), kept, dr.opaque(mi.UInt32, room))
    dr.eval(total, through, count, kept)
    opacity = rays.opacity[:, None]
    wanted = opacity * rays.colours + (1.0 - opacity) * backgrounds
    clear = np.array(through)[:, None]
    off = download(total).T + clear * backgrounds - wanted
    g = _vectors((2.0 / (3 * n)) * off)
    counts = np.array(count)
    ray = np.repeat(np.arange(n), counts)
    slot = np.arange(len(ray)) - np.repeat(np.cumsum(counts) - counts, counts) + ray * room
    batch = (matter, kept, o, d, g, behind, total, through)
    network = matter.network
    few = int(np.searchsorted(ray, -(-n // _SHARE)))
    parameters = network.encoding.data, network.packed
    dr.enable_grad(parameters[0])
    _carry_back(*batch, ray[few:], slot[few:])
    dr.enable_grad(parameters[1])
    _carry_back(*batch, ray[:few], slot[:few])
    gradients = [dr.grad(parameter) for parameter in parameters]
    dr.disable_grad(*parameters)
    return Outcome(float((off**2).mean()), len(ray), *gradients)


def _carry_back(
    matter: Matter,
    kept: list[Any],
    o: mi.Vector3f,
    d: mi.Vector3f,
    g: mi.Vector3f,
    behind: mi.Vector3f,
    total: mi.Color3f,
    through: mi.Float,
    rays: NDArray[np.int64],
    slots: NDArray[np.int64],
) -> None:
    """Add to the parameters' gradients what places owe, given the ray of each and where it is kept."""
    import mitsuba as mi

    if len(rays) == 0:
        return
    ray, slot = upload(mi.UInt32, rays), upload(mi.UInt32, slots)
    t, after, w, *so_far = (dr.gather(mi.Float, values, slot) for values in kept)
    origin, direction, adjoint, back = (dr.gather(mi.Vector3f, values, ray) for values in (o, d, g, behind))
    all_of_it, end = dr.gather(mi.Color3f, total, ray), dr.gather(mi.Float, through, ray)
    here = sample(matter, mi.Vector3f(origin + t * direction), t * matter.width, basis(direction)[0])
    farther = mi.Vector3f(all_of_it) - mi.Vector3f(*so_far) + end * back
    seen = mi.Vector3f(dr.detach(here.colour))
    owed = here.step * dr.dot(after * seen - farther, adjoint)
    dr.backward(here.sigma * owed + w * dr.dot(mi.Vector3f(here.colour), adjoint))


def _vectors(values: NDArray[Any]) -> mi.Vector3f:
    import mitsuba as mi

    return mi.Vector3f(*(upload(mi.Float, values[:, k]) for k in range(3)))


@dataclass
class Moments:
    """Adam's running means of a parameter's gradient and of its square."""

    first: Any
    second: Any

    @staticmethod
    def zero(count: int) -> Moments:
        """Before the first step."""
        import mitsuba as mi

        return Moments(dr.opaque(mi.Float, 0.0, count), dr.opaque(mi.Float, 0.0, count))

    def stepped(self, value: Any, gradient: Any, rate: float, steps: int) -> Any:
        """The parameter after a step; entries that have no gradient stay as they are.

        Source: Kingman and Ba, "Adam", ICLR 2015, algorithm 1.
        """
        import mitsuba as mi

        touched = gradient != 0.0
        first = dr.fma(gradient - self.first, 1.0 - _BETA_1, self.first)
        second = dr.fma(dr.square(gradient) - self.second, 1.0 - _BETA_2, self.second)
        scale = dr.opaque(mi.Float, rate * np.sqrt(1.0 - _BETA_2**steps) / (1.0 - _BETA_1**steps))
        moved = value - scale * first / (dr.sqrt(second) + _EPSILON)
        self.first = dr.select(touched, first, self.first)
        self.second = dr.select(touched, second, self.second)
        return dr.select(touched, moved, value)


_BETA_1, _BETA_2, _EPSILON = 0.9, 0.99, 1e-15

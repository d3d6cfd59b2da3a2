"""What a camera's motion does to a splat's exponent and size, in closed form.

In the camera's frame a centre p moves by −ρ − φ × p and the axes V of its covariance turn by −φ × V. With
B = J V as in `splat_projection`, Σ = B Bᵀ (no dilation), N = Σ_z Jᵀ of the third row of V Vᵀ, and any film
covector w,

    ½ wᵀ dΣ w = −(wᵀΣw) d ln z − (N·w)(c_x dX' + c_y dY') + φ · (c × s)
    c = (c_x, c_y, −X' c_x − Y' c_y),  c_x = k_x w_x / z,  c_y = k_y w_y / z
    s = V Bᵀ w = (X' N·w + (z/k_x) (Σw)_x,  Y' N·w + (z/k_y) (Σw)_y,  N·w)

so that two numbers per splat, N, do what a table of 3 x 6 would; dX = (dx − X dz) / z likewise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

if TYPE_CHECKING:
    import mitsuba as mi


def swelling(
    direction: mi.Vector2f,
    held: mi.Vector2f,
    z: mi.Float,
    k: mi.Vector2f,
    w: mi.Vector2f,
    n: mi.Float,
    spread: mi.Vector2f,
    pull: mi.Vector2f | float = 0.0,
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """½ wᵀ dΣ w + pull·d(X, Y), as what multiplies ρ and φ.

    Args:
        direction: X and Y.
        held: X' and Y', which have no slope where they differ from those.
        z: depth.
        k: the camera's, 1 / `Camera.scale`.
        w: on the film.
        n: N·w.
        spread: Σw.
        pull: what else depends on X and Y.
    """
    import mitsuba as mi

    inverse = dr.rcp(z)
    c = k * w * inverse
    g = dr.select(direction == held, -n * c, 0.0) + pull
    moved = mi.Vector3f(g.x, g.y, -dr.dot(w, spread) - dr.dot(direction, g))
    lever = mi.Vector3f(c.x, c.y, -dr.dot(held, c))
    s = mi.Vector3f(held.x * n + z / k.x * spread.x, held.y * n + z / k.y * spread.y, n)
    turned = dr.cross(moved, mi.Vector3f(direction.x, direction.y, 1.0)) + dr.cross(lever, s)
    return -inverse * moved, turned

"""Lens models: where a lens sends a point u of the plane at depth one, and how it stretches the plane there.

    D(u) = g(q) u + T(u),  q = |u|²,  in axes x right, y down

    opencv   g = (1 + k1 q + k2 q² + k3 q³)/(1 + k4 q + k5 q² + k6 q³)
             T = (2 p1 x y + p2 (q + 2x²), p1 (q + 2y²) + 2 p2 x y)
    fisheye  g = (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) θ/r,  r = √q, θ = arctan r,  T = 0

D is a gradient, hence D' = [[a, b], [b, c]] is symmetric, and third derivatives do not mind the order either.
`m` is the library of the arrays, NumPy or Dr.Jit: kernels and NumPy share one set of formulas. `k` are the
coefficients in the order of `LENS_MODELS`.

Source: OpenCV 4, calib3d; Kannala and Brandt 2006 for the fisheye.
"""

from __future__ import annotations

from typing import Any

_AXIS = 1e-12
"""Added to q, so that nothing is divided by zero on the axis: moves D by 1e-12 of itself at most."""
_STEPS = 6
"""Of Newton's method: three are enough where D is radial, and the start right but for the tangential part."""


def distorted(m: Any, model: str, k: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """D(u)."""
    q = x * x + y * y + _AXIS
    g = _radial(m, model, k, q)[0]
    if model == "fisheye":
        return g * x, g * y
    p1, p2 = k[2], k[3]
    cross = 2.0 * x * y
    return g * x + p1 * cross + p2 * (q + 2.0 * x * x), g * y + p1 * (q + 2.0 * y * y) + p2 * cross


def stretch(m: Any, model: str, k: Any, x: Any, y: Any) -> tuple[Any, Any, Any]:
    """a, b and c of D'(u)."""
    g, g1, _ = _radial(m, model, k, x * x + y * y + _AXIS)
    a, b, c = g + 2.0 * g1 * x * x, 2.0 * g1 * x * y, g + 2.0 * g1 * y * y
    if model == "fisheye":
        return a, b, c
    p1, p2 = k[2], k[3]
    return a + 2.0 * p1 * y + 6.0 * p2 * x, b + 2.0 * p1 * x + 2.0 * p2 * y, c + 6.0 * p1 * y + 2.0 * p2 * x


def least_stretch(m: Any, model: str, k: Any, x: Any, y: Any) -> Any:
    """The smaller eigenvalue of D'(u)."""
    a, b, c = stretch(m, model, k, x, y)
    half = 0.5 * (a - c)
    return 0.5 * (a + c) - m.sqrt(half * half + b * b)


def swelling(m: Any, model: str, k: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """∇ ln det D'(u): how the area that a lens makes of a small patch changes from place to place."""
    _, g1, g2 = _radial(m, model, k, x * x + y * y + _AXIS)
    a, b, c = stretch(m, model, k, x, y)
    xxx, xxy = (6.0 * g1 + 4.0 * g2 * x * x) * x, (2.0 * g1 + 4.0 * g2 * x * x) * y
    xyy, yyy = (2.0 * g1 + 4.0 * g2 * y * y) * x, (6.0 * g1 + 4.0 * g2 * y * y) * y
    if model != "fisheye":
        p1, p2 = k[2], k[3]
        xxx, xxy, xyy, yyy = xxx + 6.0 * p2, xxy + 2.0 * p1, xyy + 2.0 * p2, yyy + 6.0 * p1
    area = a * c - b * b
    return (xxx * c + a * xyy - 2.0 * b * xxy) / area, (xxy * c + a * yyy - 2.0 * b * xyy) / area


def undistorted(m: Any, model: str, k: Any, x: Any, y: Any, start: Any) -> tuple[Any, Any]:
    """D⁻¹ of a point (x, y), by Newton's method.

    Args:
        start: about |D⁻¹| over |(x, y)|; for the fisheye θ over it. See `start_of`.
    """
    if model == "fisheye":
        rho = m.sqrt(x * x + y * y + _AXIS)
        theta = rho * start
        for _ in range(_STEPS):
            p, p1, _ = _series((1.0, *k), theta * theta)
            theta = theta - (theta * p - rho) / (p + 2.0 * theta * theta * p1)
        ratio = m.tan(theta) / rho
        return ratio * x, ratio * y
    u, v = start * x, start * y
    for _ in range(_STEPS):
        a, b, c = stretch(m, model, k, u, v)
        at_x, at_y = distorted(m, model, k, u, v)
        dx, dy, area = at_x - x, at_y - y, a * c - b * b
        u, v = u - (c * dx - b * dy) / area, v - (a * dy - b * dx) / area
    return u, v


def start_of(m: Any, model: str, r: Any) -> Any:
    """What `undistorted` starts from, times |D(u)|, at |u| = r."""
    return m.atan(r) if model == "fisheye" else r


def motion(m: Any, model: str, k: Any, index: int, x: Any, y: Any) -> tuple[Any, Any, Any]:
    """How D(u) moves per unit of coefficient `index`, and the divergence of that motion on the film.

    w = ∂D/∂k at fixed u; its divergence in D(u), not in u, is ∂ ln det D'/∂k = tr(D'⁻¹ ∂D'/∂k).
    """
    a, b, c = stretch(m, model, k, x, y)
    area = a * c - b * b
    if model == "opencv" and index in (2, 3):
        along, across = (y, x) if index == 2 else (x, y)
        near, cross = 3.0 * along * along + across * across, 2.0 * x * y
        # ∂D' is [[2y, 2x], [2x, 6y]] for p1 and [[6x, 2y], [2y, 2x]] for p2.
        da, dc = (2.0 * y, 6.0 * y) if index == 2 else (6.0 * x, 2.0 * x)
        w = (cross, near) if index == 2 else (near, cross)
        return *w, (da * c + a * dc - 4.0 * b * across) / area
    q = x * x + y * y + _AXIS
    s, s1 = _radial_motion(m, model, k, index, q)
    trace = s * (a + c) + 2.0 * s1 * (x * x * c + y * y * a - 2.0 * x * y * b)
    return s * x, s * y, trace / area


def _radial(m: Any, model: str, k: Any, q: Any) -> tuple[Any, Any, Any]:
    """g and its first two derivatives in q."""
    if model == "fisheye":
        (f, f1, f2), (s, s1, s2) = _angle(m, q)
        p, p1, p2 = _series((1.0, *k), s)
        g1 = f1 * p + f * p1 * s1
        return f * p, g1, f2 * p + 2.0 * f1 * p1 * s1 + f * (p2 * s1 * s1 + p1 * s2)
    n, n1, n2 = _series((1.0, k[0], k[1], k[4]), q)
    d, d1, d2 = _series((1.0, k[5], k[6], k[7]), q)
    g = n / d
    g1 = (n1 - g * d1) / d
    return g, g1, (n2 - 2.0 * g1 * d1 - g * d2) / d


def _radial_motion(m: Any, model: str, k: Any, index: int, q: Any) -> tuple[Any, Any]:
    """∂g/∂k of a coefficient, and its derivative in q."""
    if model == "fisheye":
        (f, f1, _), (s, s1, _) = _angle(m, q)
        power = _power(s, index)  # θ^2j / θ²
        return f * power * s, f1 * power * s + (index + 1.0) * f * power * s1
    d, d1, _ = _series((1.0, k[5], k[6], k[7]), q)
    j = (0, 1, 0, 0, 2, 0, 1, 2)[index]  # k1, k2, (p1, p2,) k3, k4, k5, k6
    power = _power(q, j)
    t = power * q / d
    t1 = ((j + 1.0) * power - t * d1) / d
    if index < 5:
        return t, t1
    g, g1, _ = _radial(m, model, k, q)
    return -g * t, -(g1 * t + g * t1)


def _angle(m: Any, q: Any) -> tuple[tuple[Any, Any, Any], tuple[Any, Any, Any]]:
    """θ/r and θ², each with its first two derivatives in q = r²."""
    r = m.sqrt(q)
    f, h = m.atan(r) / r, 1.0 / (1.0 + q)
    f1 = (h - f) / (2.0 * q)
    return (f, f1, -(h * h + 3.0 * f1) / (2.0 * q)), (q * f * f, f * h, f1 * h - f * h * h)


def _series(k: Any, s: Any) -> tuple[Any, Any, Any]:
    """Σ k_j s^j and its first two derivatives, by Horner's rule."""
    p, p1, p2 = k[-1], 0.0 * s, 0.0 * s
    for coefficient in k[-2::-1]:
        p, p1, p2 = coefficient + s * p, p + s * p1, 2.0 * p1 + s * p2
    return p, p1, p2


def _power(s: Any, j: int) -> Any:
    power: Any = 1.0
    for _ in range(j):
        power = power * s
    return power

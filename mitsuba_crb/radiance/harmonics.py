"""Real spherical harmonics as polynomials in a unit direction, and their gradients, up to degree 4.

Order and signs are those of Kerbl et al. 2023 and gsplat, k = l² + l + m, so that a file's coefficients fit.
A polynomial's gradient has a part along the direction that depends on how it is written: only its part across
the direction means something.
"""

from __future__ import annotations

from typing import Any

Term = tuple[float, int, int, int]
"""A factor and the powers of x, y and z."""

_C1 = 0.4886025119029199
_C2 = 1.0925484305920792
_C2_0, _C2_2 = 0.31539156525252005, 0.5462742152960396
_C3_1, _C3_0 = 0.4570457994644658, 0.3731763325901154
_C3_3, _C3_2 = 0.5900435899266435, 1.445305721320277
_C4 = (2.5033429417967046, 1.7701307697799304, 0.9461746957575601, 0.6690465435572892, 0.10578554691520431)

HARMONICS: tuple[tuple[Term, ...], ...] = (
    ((0.28209479177387814, 0, 0, 0),),
    ((-_C1, 0, 1, 0),),
    ((_C1, 0, 0, 1),),
    ((-_C1, 1, 0, 0),),
    ((_C2, 1, 1, 0),),
    ((-_C2, 0, 1, 1),),
    ((2 * _C2_0, 0, 0, 2), (-_C2_0, 2, 0, 0), (-_C2_0, 0, 2, 0)),
    ((-_C2, 1, 0, 1),),
    ((_C2_2, 2, 0, 0), (-_C2_2, 0, 2, 0)),
    ((-3 * _C3_3, 2, 1, 0), (_C3_3, 0, 3, 0)),
    ((2 * _C3_2, 1, 1, 1),),
    ((-4 * _C3_1, 0, 1, 2), (_C3_1, 2, 1, 0), (_C3_1, 0, 3, 0)),
    ((2 * _C3_0, 0, 0, 3), (-3 * _C3_0, 2, 0, 1), (-3 * _C3_0, 0, 2, 1)),
    ((-4 * _C3_1, 1, 0, 2), (_C3_1, 3, 0, 0), (_C3_1, 1, 2, 0)),
    ((_C3_2, 2, 0, 1), (-_C3_2, 0, 2, 1)),
    ((-_C3_3, 3, 0, 0), (3 * _C3_3, 1, 2, 0)),
    ((_C4[0], 3, 1, 0), (-_C4[0], 1, 3, 0)),
    ((-3 * _C4[1], 2, 1, 1), (_C4[1], 0, 3, 1)),
    ((7 * _C4[2], 1, 1, 2), (-_C4[2], 1, 1, 0)),
    ((-7 * _C4[3], 0, 1, 3), (3 * _C4[3], 0, 1, 1)),
    ((35 * _C4[4], 0, 0, 4), (-30 * _C4[4], 0, 0, 2), (3 * _C4[4], 0, 0, 0)),
    ((-7 * _C4[3], 1, 0, 3), (3 * _C4[3], 1, 0, 1)),
    ((3.5 * _C4[2], 2, 0, 2), (-0.5 * _C4[2], 2, 0, 0), (-3.5 * _C4[2], 0, 2, 2), (0.5 * _C4[2], 0, 2, 0)),
    ((-_C4[1], 3, 0, 1), (3 * _C4[1], 1, 2, 1)),
    ((0.25 * _C4[0], 4, 0, 0), (-1.5 * _C4[0], 2, 2, 0), (0.25 * _C4[0], 0, 4, 0)),
)
"""The polynomial of each."""


def harmonic(k: int, powers: Any) -> tuple[Any, list[Any]]:
    """The k-th one's value and its gradient [x, y, z].

    Args:
        powers: `powers_of` the direction.
    """
    value, gradient = 0.0, [0.0, 0.0, 0.0]
    for factor, *exponents in HARMONICS[k]:
        value = value + factor * _monomial(powers, exponents)
        for axis in range(3):
            if exponents[axis] > 0:
                lower = [exponents[j] - (j == axis) for j in range(3)]
                gradient[axis] = gradient[axis] + factor * exponents[axis] * _monomial(powers, lower)
    return value, gradient


def harmonics(direction: Any, count: int) -> tuple[list[Any], list[list[Any]]]:
    """Values and gradients [x, y, z] of the first ones."""
    powers = powers_of(direction)
    values, gradients = zip(*(harmonic(k, powers) for k in range(count)), strict=True)
    return list(values), list(gradients)


def powers_of(direction: Any) -> list[list[Any]]:
    """The powers 0 to 4 of x, y and z of a unit direction; arrays of any kind."""
    found = []
    for component in direction:
        powers = [1.0, component]
        for _ in range(3):
            powers.append(powers[-1] * component)
        found.append(powers)
    return found


def _monomial(powers: Any, exponents: list[int]) -> Any:
    product: Any = 1.0
    for axis, exponent in enumerate(exponents):
        if exponent > 0:
            product = product * powers[axis][exponent]
    return product

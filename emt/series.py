"""Power series shortened to what an interval needs."""

from collections.abc import Sequence
from fractions import Fraction
from math import comb


def chebyshev_on_unit(n: int) -> list[Fraction]:
    """Coefficients of T_n(2u - 1), constant first: the polynomial of degree n that strays least from zero on [0, 1],
    for its leading coefficient 2^(2n - 1)."""
    return [Fraction((-1) ** (n - k) * 4**k * n * comb(n + k, 2 * k), n + k) for k in range(n + 1)]


def economised(series: Sequence[Fraction], bound: Fraction, terms: int) -> list[float]:
    """The first coefficients of a power series, changed to make up for the others on [0, bound].

    The last term is exchanged for a polynomial of less degree that differs from it by a multiple of a Chebyshev
    polynomial, again and again. Without the coefficient c of degree n, the error is about c boundⁿ / 2^(2n - 1), where
    leaving the term out would make it c boundⁿ.

    Args:
        series: coefficients, constant first, as many as leave no error.

    Source: C. Lanczos, J. Math. Phys. 17 (1938) 123-199, who calls it telescoping.
    """
    scaled = [c * bound**k for k, c in enumerate(series)]
    while len(scaled) > terms:
        last = scaled.pop()
        straight = chebyshev_on_unit(len(scaled))
        scaled = [c - last / straight[-1] * t for c, t in zip(scaled, straight, strict=False)]
    return [float(c / bound**k) for k, c in enumerate(scaled)]

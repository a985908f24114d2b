"""Shortened power series against exact arithmetic."""

from fractions import Fraction
from math import factorial

import mpmath
import numpy as np
import pytest

from emt.logarithm import SERIES
from emt.series import chebyshev_on_unit, economised
from emt.trigonometry import ARC, SINE


@pytest.mark.parametrize("n", range(1, 16))
def test_chebyshev_polynomials_on_the_unit_interval(n):
    u = np.linspace(0.0, 1.0, 101)
    exact = [float(sum(c * Fraction(x) ** k for k, c in enumerate(chebyshev_on_unit(n)))) for x in u]
    np.testing.assert_allclose(exact, np.cos(n * np.arccos(2.0 * u - 1.0)), atol=1e-13)


def test_error_is_that_of_the_first_term_left_out_over_a_power_of_two():
    series = [Fraction(1, factorial(k)) for k in range(20)]
    kept = economised(series, Fraction(1), 6)
    u = np.linspace(0.0, 1.0, 401)
    worst = np.abs(np.polynomial.polynomial.polyval(u, kept) - np.exp(u)).max()
    expected = 1.0 / factorial(6) / 2.0**11
    assert expected < worst < 2.0 * expected  # the terms behind add to it


def test_nothing_is_left_out_of_a_short_series():
    assert economised([Fraction(1), Fraction(-1, 2)], Fraction(1, 3), 2) == [1.0, -0.5]


@pytest.mark.parametrize(
    ("series", "function", "bound"),
    [
        (SINE, lambda x: mpmath.sin(x) / x, mpmath.pi / 2),
        (ARC, lambda x: mpmath.atan(x) / x, mpmath.tan(mpmath.pi / 32)),
        (SERIES, lambda x: 2 * mpmath.atanh(x) / x, (mpmath.sqrt(2) - 1) ** 2),
    ],
)
def test_series_in_use_are_good_to_an_eighth_of_the_last_bit_of_1(series, function, bound):
    assert series[0] == round(series[0])  # which sine and direction take for granted
    with mpmath.workdps(30):
        for k in range(1, 201):
            x = bound * k / 200
            found = mpmath.fsum(mpmath.mpf(c) * x ** (2 * j) for j, c in enumerate(series))
            assert abs(found - function(x)) < 2.0**-55

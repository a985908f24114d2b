"""Floating-point operations of a run and step of each workload, counted from the equations.

Additions, multiplications, divisions and square roots count as one; sines, cosines, exponentials and logarithms as
`FUNCTION` each. Selections, comparisons and changes of sign are free. Symmetric matrices are counted by their different
entries, and what a scan or the settings determine is computed once, as anybody would who writes the equations out by
hand; what a filter does besides (diagnostics, guards, metrics, padding) is not work. So the counts are of what has to
be done, not of what is done, and a rate that follows from them is a lower bound.
"""

from collections.abc import Callable

FUNCTION = 20
"""Of a sine, cosine, exponential or logarithm."""
SINCOS = 2 * FUNCTION

# two by two: S symmetric, M general
DET, OUTER, ADD = 3, 3, 3
INVERSE = DET + 1 + 3
APPLY, QUADRATIC = 6, 9
PRODUCT = 12
"""Of two matrices of which the result is general."""
CONGRUENCE = PRODUCT + 9
"""M S Mᵀ."""


def dot(n: int) -> int:
    """Inner product of n entries."""
    return 2 * n - 1


def cholesky(n: int) -> int:
    """Factor of a symmetric (n, n)."""
    return (n**3 - n) // 3 + n * (n - 1) // 2 + n


def gram(n: int, m: int) -> int:
    """Different entries of A Aᵀ with A (n, m)."""
    return n * (n + 1) // 2 * dot(m)


def prediction() -> int:
    """Constant velocity in the plane: mean, and covariance by its 2x2 blocks."""
    mean, position, cross, velocity = 4, 5 * 3 + ADD, 2 * 4 + 4, ADD
    return mean + position + cross + velocity


def velocity_after_position() -> int:
    """Velocity and its covariance after a scan that measured the position: once per scan, by the regression on it."""
    gain, mean, cross, own = INVERSE + PRODUCT, 2 + APPLY + 2, PRODUCT, ADD + CONGRUENCE + ADD
    return gain + mean + cross + own


def scan_statistics(points: float) -> float:
    """Mean and scatter of the points of a scan."""
    return 10 * points + 3


def vb(points: float, iterations: int) -> float:
    """Variational-Bayes random matrix: `iterations` fixed-point iterations on the statistics of a scan."""
    weights = 4  # a / (s b)
    turn = 1 + SINCOS + 1 + FUNCTION  # of twice the orientation, and what its variance takes away
    information = 4 + 1 + 2 + 2  # A, a rotated diagonal
    scatter = 2 + OUTER + 2 * ADD + 3 + ADD  # Ψ
    position_cov = 3 + ADD + INVERSE
    position = 2 + 2 * APPLY + 2
    extent = 4 + 2 * 3 + 1 + 2 + 2 + 2
    points_cov = ADD + INVERSE
    points_mean = 2 + 2 * APPLY + 2
    points_scatter = PRODUCT + CONGRUENCE
    orientation = 5 + 5 + 3 + 2
    iteration = (
        weights + turn + information + scatter + position_cov + position + extent
        + points_cov + points_mean + points_scatter + orientation
    )  # fmt: skip
    forgetting, noise, shapes, start, report = 4, 1, 3, 4, 6
    scan = prediction() + forgetting + noise + shapes + start + scan_statistics(points) + INVERSE
    return iterations * iteration + scan + velocity_after_position() + report


def mem_ekf_star(points: float) -> float:
    """MEM-EKF*: an extended Kalman update per point, in the frame of the axes, where its matrices are diagonal."""
    spread = 8 + 3 + 3 + CONGRUENCE + ADD  # of a point about the centre
    innovation = ADD + INVERSE + 2
    position = PRODUCT + APPLY + 2 + PRODUCT + ADD
    turned = CONGRUENCE + 2 * APPLY
    slopes = 4
    pull = 3 + 4 + 4  # M C_Y⁻¹ (Y - Ȳ)
    information = 5 + 3 + 3 + 4 + 4 + 4  # M C_Y⁻¹ M
    mean = 3 * dot(3) + 3
    covariance = 9 * dot(3) + 6 * dot(3) + 6
    point = SINCOS + spread + innovation + position + turned + slopes + pull + information + mean + covariance
    return points * point + prediction() + 6 + velocity_after_position()


def moment_ukf(points: float) -> float:
    """Image moments: two interacting unscented filters, straight (7 states) and turning (8).

    Six columns of a square root move the pseudo-measurement of a point, so a filter looks at thirteen sigma points.
    """
    sigma, moved = 13, 6

    def complies() -> int:
        """Whether moments need a projection, by sum and product of the eigenvalues; few do, which is not counted."""
        return DET + 1 + 2

    def inverse() -> int:
        return complies() + 1 + 3

    def expected() -> int:
        """Moments of the pseudo-measurement of one point, from inverses and positions of the sigma points."""
        values, gaps, bend, cross, variance = sigma * (2 + QUADRATIC), 12, 13, 12, 2 * 12 + 4
        noise = QUADRATIC + 4
        return values + gaps + bend + cross + variance + noise

    def rule() -> int:
        """Sigma points of a belief, the inverses of their moments, and what noise adds to the first."""
        return moved * 15 + sigma * inverse() + 3 * PRODUCT + 10

    def update(n: int) -> int:
        gain, rest, root = n * dot(moved), dot(moved) + 5, n + 2 * n * moved
        return rule() + expected() + gain + rest + root + 3 * n + complies()

    def likelihood() -> int:
        return expected() + FUNCTION + 6

    def turn() -> int:
        """Of one sigma point."""
        return 1 + 2 * SINCOS + 12 + 14 + 12

    def predict(n: int) -> int:
        mixed = n + n * (n + 1) // 2 * 6
        if n == 7:
            return mixed + 4 + 2 * 2 * n + 4 * 4 + 6 + cholesky(n)
        return mixed + 2 * cholesky(n) + n * n * 2 + 17 * turn() + gram(n, 2 * n) + 4 * n * n

    filters = sum(predict(n) + gram(n, n) + rule() + points * (likelihood() + update(n)) for n in (7, 8))
    probabilities, report = 4 + 2 + 4 + 2 * (FUNCTION + 3), 3 * 7 + 15 + FUNCTION
    return filters + probabilities + report


def shape_mixture(points: float, samples: int) -> float:
    """The arm with a claw: a sampling update per point by each of four segments and a disc, weighed by likelihood."""
    n, segments, placing = 8, 4, 1 + 2 + 4 + 5 + 7  # entries of the rows of a root that place the segments
    states = samples * (2 * placing)
    chain = samples * (3 * (1 + SINCOS) + 2 * 6 + 2 + 2 * 4 + 4 * 2 + 4)  # residuals of all segments
    entries = 2 * segments
    moments = samples * (2 * entries + segments * 3 * 2) + entries + 5 * segments
    cross = entries * n * dot(samples) + entries * gram(n, 1) * 2
    density = segments * (INVERSE + APPLY + 3 + FUNCTION + 4) + 13 + FUNCTION
    weights = (segments + 1) * (FUNCTION + 4)
    mean = segments * n * 5 + n
    covariance = segments * (9 + 2 * n * 3 + n * (n + 1) // 2 * 4) + n * (n + 1)
    point = cholesky(n) + states + chain + moments + cross + density + weights + mean + covariance
    predicted = 6 + 3 * 2 * 2 * n + n
    return points * point + predicted


def multiple_model(points: float, motions: int) -> float:
    """Interacting multiple models of a point with four states whose position is measured."""
    r, entries = motions, 4 + 10
    probabilities = r * (dot(r) + 1)
    mixing = 4 * 2 * r + 4 * r + r * 10 * 2 + r * entries * (1 + dot(r) + 1) + r * (10 * 2 + 4)
    predicted = r * (prediction() + 4)
    gain, mean, cov = 4 * 2 * 3, 2 + 4 * 4, 10 * 4
    update = r * (2 + INVERSE + gain + mean + cov + QUADRATIC + FUNCTION + 2)
    bayes = r * (FUNCTION + 4)
    return probabilities + mixing + predicted + points * (update + bayes) + 4 * dot(r)


COUNTS: dict[str, Callable[[float, dict], float]] = {
    "vb": lambda points, told: vb(points, told["iterations"]),
    "mem_ekf_star": lambda points, told: mem_ekf_star(points),
    "moment_ukf": lambda points, told: moment_ukf(points),
    "shape_mixture": lambda points, told: shape_mixture(points, told["samples"]["count"]),
    "multiple_model": lambda points, told: multiple_model(points, told["motions"]),
}
"""Operations per run and step by workload, of the mean number of points per scan and the settings of the filter."""

"""The variational Bayes tracker with explicit orientation, all runs at once (see `tests.reference.vb`).

B. Tuncer and E. Özkan, IEEE Trans. Signal Process. 69 (2021) 1910-1923. Two things save work, and both are exact. The
noise-free points are affine in the measurements, z_j = y_j + Sz A (H x - y_j), so that their sums follow from count,
mean and scatter of the scan. And an iteration needs the kinematics at the position only; the velocity follows once.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference.batched import kinematics, plane
from tests.reference.batched.points import counts_of, points_about, statistics
from tests.reference.batched.trigonometry import sincos_of_double
from tests.reference.worlds import EllipseWorld

Array = NDArray[np.float64]


class Belief(NamedTuple):
    """What the runs believe."""

    mean: Array
    cov: Array
    """Kinematics (4, run) and (10, run), in the order of `kinematics`; updated in place."""
    theta: Array
    S: Array
    """Orientation [rad] and its variance (run,)."""
    a: Array
    b: Array
    """Shapes and scales [length^2] of the squared semi-axes (2, run)."""


def predict(belief: Belief, dt: float, noise: kinematics.Noise, theta_var: float, forgetting: float) -> Belief:
    """Time update: linear motion, random-walk orientation, exponential forgetting of shapes and scales."""
    kinematics.predict(belief.mean, belief.cov, dt, noise)
    return belief._replace(S=belief.S + theta_var, a=forgetting * belief.a, b=forgetting * belief.b)


def update(belief: Belief, points: Array, counts: NDArray[np.int64], R: Array, s: float, n_iterations: int) -> Belief:
    """Measurement update by mean-field fixed-point iterations, in Jacobi order.

    points (run, slot, 2), of which the first `counts` (run,) are real; R (2, 2) noise covariance, s spread factor. An
    empty scan moves nothing but by rounding.
    """
    # all positions are relative to the predicted one
    y_bar, scatter = statistics(points_about(points, counts, belief.mean[:2]), counts)
    m = counts.astype(float)
    R_inv = plane.inverse(plane.entries(R))
    weighed_scatter = plane.sandwich(R_inv, scatter)
    C0 = belief.cov[kinematics.POSITION].copy()
    C0_inv = plane.inverse(C0)
    theta0, S0, a0, b0 = belief.theta, belief.S, belief.a, belief.b

    position, C, theta, S, a, b = np.zeros_like(y_bar), C0, theta0, S0, a0, b0
    z_bar, Sz = y_bar, np.zeros_like(C0)
    Sz[:2] = s * b / (a - 1.0)
    a_new = a0 + 0.5 * m

    for _ in range(n_iterations):
        # Expectations under the previous iterate, by the double angle (Lemma 1).
        d = a / (s * b)
        half_sum, half_gap = 0.5 * (d[0] + d[1]), 0.5 * (d[0] - d[1])
        sin, cos = sincos_of_double(theta)
        shrink = np.exp(-2.0 * S)
        bent = shrink * half_gap
        A = np.empty_like(C)
        np.multiply(bent, cos, out=A[0])
        np.subtract(half_sum, A[0], out=A[1])
        A[0] += half_sum
        np.multiply(bent, sin, out=A[2])
        Psi = plane.outer(z_bar - position)
        Psi += C
        Psi += Sz
        Psi *= m
        Psi += scatter

        # Kinematics: the posterior of the position alone.
        J = m * A
        C_new = plane.inverse(C0_inv + J)
        position_new = plane.apply(C_new, plane.apply(J, z_bar))

        # Extent.
        mean, half = 0.5 * (Psi[0] + Psi[1]), 0.5 * (Psi[0] - Psi[1])
        along, across = half * cos + Psi[2] * sin, Psi[2] * cos - half * sin
        shrink *= along
        b_new = np.empty_like(b0)
        np.add(mean, shrink, out=b_new[0])
        np.subtract(mean, shrink, out=b_new[1])
        b_new *= 0.5 / s
        b_new += b0

        # Noise-free points, by their mean and scatter.
        B = A + R_inv
        det_B = plane.det(B)
        Sz = plane.inverse(B, det_B)
        z_bar = y_bar + plane.apply(Sz, plane.apply(A, position - y_bar))
        scatter = plane.inner(Sz, weighed_scatter) * Sz - plane.adjugate(weighed_scatter) / det_B

        # Orientation, linearised about its previous mean.
        G = 2.0 * (half_sum * mean - half_gap * along)
        S_new = S0 / (1.0 + S0 * G)
        theta = theta0 + S_new * (G * (theta - theta0) - 2.0 * half_gap * across)
        position, C, S, a, b = position_new, C_new, S_new, a_new, b_new

    kinematics.regress(belief.mean, belief.cov, position, C)
    return Belief(belief.mean, belief.cov, theta, S, a, b)


def track(
    points: Array, mask: NDArray[np.bool_], world: EllipseWorld, shape: Array, orientation_variance: float,
    orientation_noise: float, forgetting: float, n_iterations: int,
) -> Array:  # fmt: skip
    """Reports (run, step, 7) of x, y, vx, vy, both semi-axes and the orientation, from points (run, step, slot, 2).

    shape (2,) prior inverse-gamma shapes; orientation_noise is added to the variance per step.
    """
    runs, n_steps = mask.shape[:2]
    counts = counts_of(mask)
    noise = kinematics.white_acceleration(world.psd, world.dt)
    belief = Belief(
        np.tile(world.mean[:, None], runs), np.tile(kinematics.blocks(world.cov)[:, None], runs),
        np.full(runs, world.orientation), np.full(runs, orientation_variance), np.tile(shape[:, None], runs),
        np.tile(((shape - 1.0) * world.semi_axes**2)[:, None], runs),
    )  # fmt: skip
    reports = np.empty((n_steps, 7, runs))
    for k in range(n_steps):
        belief = predict(belief, world.dt, noise, orientation_noise, forgetting)
        belief = update(belief, points[:, k], counts[:, k], world.noise_cov, world.extent_scale, n_iterations)
        reports[k, :4] = belief.mean
        reports[k, 4:6] = np.sqrt(belief.b / (belief.a - 1.0))
        reports[k, 6] = belief.theta
    return reports.transpose(2, 0, 1)

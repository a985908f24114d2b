"""The variational Bayes tracker with explicit orientation, from the equations.

B. Tuncer and E. Özkan, IEEE Trans. Signal Process. 69 (2021) 1910-1923, doi:10.1109/TSP.2021.3065136: the update of
Sec. III with Lemma 1, every factor computed from the previous iterate, and the time update of Sec. IV. Model, with
L(theta) the rotation and X = diag(X1, X2) the squared semi-axes,

    y_j | z_j ~ N(z_j, R),    z_j | x, X, theta ~ N(H x, s L X Lᵀ),    X_i ~ IG(a_i, b_i).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from emt.benchmark.peers.base import Scans
from emt.benchmark.peers.models import prior_means, settings_of
from emt.benchmark.plain.base import EllipseModel, Prepared, over_runs, rotation, where_each
from emt.config.experiment import Experiment


class Belief(NamedTuple):
    """Density of kinematics, orientation and extent."""

    x: Float[Array, "4"]
    P: Float[Array, "4 4"]
    """Position and velocity (m, m/s)."""
    theta: Float[Array, ""]
    S: Float[Array, ""]
    """Orientation (rad) and its variance."""
    a: Float[Array, "2"]
    b: Float[Array, "2"]
    """Inverse-gamma shapes, and scales (m²), of the squared semi-axes."""


def expected_rotation(
    M: Float[Array, "2 2"], mean: Float[Array, ""], variance: Float[Array, ""]
) -> Float[Array, "2 2"]:  # fmt: skip
    """Lemma 1: E[L(t) M L(t)ᵀ] for t ~ N(mean, variance); with -mean, E[L(t)ᵀ M L(t)]."""
    (p, q), (r, w) = M
    C = jnp.exp(-2.0 * variance) * jnp.cos(2.0 * mean)
    D = jnp.exp(-2.0 * variance) * jnp.sin(2.0 * mean)
    return 0.5 * jnp.array(
        [
            [p * (1 + C) + w * (1 - C) - (q + r) * D, q * (1 + C) - r * (1 - C) + (p - w) * D],
            [r * (1 + C) - q * (1 - C) + (p - w) * D, w * (1 + C) + p * (1 - C) + (q + r) * D],
        ]
    )


def rotation_derivative(theta: Float[Array, ""]) -> Float[Array, "2 2"]:
    """dL/dtheta."""
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.array([[-s, -c], [c, -s]])


def update(
    prior: Belief, y: Float[Array, "slot 2"], mask: Bool[Array, "slot"], R: Float[Array, "2 2"], s: float,
    iterations: int,
) -> Belief:  # fmt: skip
    """Measurement update by mean-field iterations, with a noise-free point z_j for every slot."""
    H = jnp.eye(2, 4)
    m = mask.sum(dtype=y.dtype)
    P0_inv, R_inv = jnp.linalg.inv(prior.P), jnp.linalg.inv(R)

    def iterate(_, now):
        (x, P, theta, S, a, b), z, Sz = now
        D = jnp.diag(a / (s * b))
        A = expected_rotation(D, theta, S)
        z_bar = jnp.where(mask[:, None], z, 0.0).sum(axis=0) / m
        gaps = jnp.where(mask[:, None], z - (H @ x)[None, :], 0.0)
        Psi = gaps.T @ gaps + m * (H @ P @ H.T + Sz)
        L, dL = rotation(theta), rotation_derivative(theta)

        P_new = jnp.linalg.inv(P0_inv + m * H.T @ A @ H)
        x_new = P_new @ (P0_inv @ prior.x + m * H.T @ A @ z_bar)

        a_new = prior.a + 0.5 * m
        b_new = prior.b + jnp.diag(expected_rotation(Psi, -theta, S)) / (2.0 * s)

        Sz_new = jnp.linalg.inv(A + R_inv)
        z_new = ((A @ H @ x)[None, :] + y @ R_inv.T) @ Sz_new.T

        # linearised about the previous mean
        G = jnp.trace(D @ dL.T @ Psi @ dL)
        g = G * theta - jnp.trace(D @ L.T @ Psi @ dL)
        S_new = 1.0 / (1.0 / prior.S + G)
        theta_new = S_new * (prior.theta / prior.S + g)
        return Belief(x_new, P_new, theta_new, S_new, a_new, b_new), z_new, Sz_new

    start = prior, y, s * jnp.diag(prior.b / (prior.a - 1.0))
    new, _, _ = jax.lax.fori_loop(0, iterations, iterate, start)
    return where_each(mask.any(), new, prior)


def prepare(experiment: Experiment, scans: Scans) -> Prepared:
    """The filter on scans of some runs."""
    model, settings = EllipseModel.of(experiment), settings_of(experiment, "vb_random_matrix")

    def step(now: Belief, scan: tuple[jax.Array, jax.Array]):
        predicted = Belief(
            model.F @ now.x,
            model.F @ now.P @ model.F.T + model.Q,
            now.theta,
            now.S + settings.orientation_noise,
            settings.forgetting * now.a,
            settings.forgetting * now.b,
        )
        points, mask = scan
        new = update(predicted, points, mask, model.R, model.extent_scale, settings.iterations)
        return new, jnp.concatenate([new.x, jnp.sqrt(new.b / (new.a - 1.0)), new.theta[None]])

    def track(mean: Float[Array, "4"], points: Float[Array, "step slot 2"], mask: Bool[Array, "step slot"]):
        a = jnp.array(settings.shape)
        orientation, variance = jnp.array(model.orientation), jnp.array(settings.orientation_variance)
        start = Belief(mean, model.cov, orientation, variance, a, (a - 1.0) * model.semi_axes**2)
        return jax.lax.scan(step, start, (points, mask))[1]

    return over_runs(track, prior_means(experiment, scans), scans.points, scans.mask)

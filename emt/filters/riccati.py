"""The steady state of a Kalman filter."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

DOUBLINGS = 40


def steady_covariance(
    transition: Float[Array, "n n"],
    matrix: Float[Array, "m n"],
    noise_cov: Float[Array, "n n"],
    measurement_cov: Float[Array, "m m"],
) -> Float[Array, "n n"]:
    """Covariance of the prediction after infinitely many steps: P = F P Fᵀ + Q - F P Hᵀ (H P Hᵀ + R)⁻¹ H P Fᵀ.

    By doubling: each pass squares the number of steps, so that 40 passes are 10¹² steps; those after convergence
    change nothing. Every pass adds positive terms.

    Source: Anderson 1978, "Second-order convergent algorithms for the steady-state Riccati equation"; Azimian 2005,
    eq. 1.13.
    """
    eye = jnp.eye(transition.shape[0], dtype=transition.dtype)
    a, g, h = transition.T, matrix.T @ jnp.linalg.solve(measurement_cov, matrix), noise_cov

    def double(_, agh):
        a, g, h = agh
        w = jnp.linalg.inv(eye + g @ h)
        return a @ w @ a, g + a @ w @ g @ a.T, h + a.T @ h @ w @ a

    _, _, h = jax.lax.fori_loop(0, DOUBLINGS, double, (a, g, h))
    return 0.5 * (h + h.T)

"""The MEM-EKF* ellipse tracker, from the equations.

S. Yang and M. Baum, IEEE Trans. Signal Process. 67 (2019) 4720-4729, doi:10.1109/TSP.2019.2929462. Model, with shape
p = (theta, l1, l2) and L(theta) the rotation,

    y = H r + L(theta) diag(l1, l2) h + v,    h ~ (0, Ch),  v ~ N(0, Cv).

The points of a scan update one after the other, each with statistics at the newest shape.
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
    """Means and covariances of kinematics and shape."""

    r: Float[Array, "4"]
    Cr: Float[Array, "4 4"]
    """Position and velocity (m, m/s)."""
    p: Float[Array, "3"]
    Cp: Float[Array, "3 3"]
    """Orientation (rad) and semi-axes (m)."""


def row_jacobians(p: Float[Array, "3"]) -> tuple[Float[Array, "2 3"], Float[Array, "2 3"]]:
    """Derivatives of the first and of the second row of S(p) = L(theta) diag(l1, l2) with respect to p."""
    theta, l1, l2 = p
    c, s, o = jnp.cos(theta), jnp.sin(theta), jnp.zeros_like(theta)
    return jnp.array([[-l1 * s, c, o], [-l2 * c, o, -s]]), jnp.array([[l1 * c, s, o], [-l2 * s, o, c]])


def update_with_one(now: Belief, y: Float[Array, "2"], Ch: Float[Array, "2 2"], Cv: Float[Array, "2 2"]) -> Belief:
    """Update kinematics and shape with one point."""
    r, Cr, p, Cp = now
    H = jnp.eye(2, 4)
    pick = jnp.array([[1.0, 0, 0, 0], [0, 0, 0, 1.0], [0, 1.0, 0, 0]])
    mirrored = jnp.array([[1.0, 0, 0, 0], [0, 0, 0, 1.0], [0, 0, 1.0, 0]])
    S = rotation(p[0]) @ jnp.diag(p[1:])
    J1, J2 = J = row_jacobians(p)

    C_I = S @ Ch @ S.T
    C_II = jnp.array([[jnp.trace(Cp @ J[n].T @ Ch @ J[m]) for n in range(2)] for m in range(2)])
    Cy = H @ Cr @ H.T + C_I + C_II + Cv
    gain = Cr @ H.T @ jnp.linalg.inv(Cy)
    e = y - H @ r
    r_new, Cr_new = r + gain @ e, Cr - gain @ H @ Cr

    # pseudo-measurement: the products of the centred point with itself
    Y, Y_bar = pick @ jnp.kron(e, e), pick @ Cy.reshape(4)
    M = jnp.stack([2.0 * S[0] @ Ch @ J1, 2.0 * S[1] @ Ch @ J2, S[0] @ Ch @ J2 + S[1] @ Ch @ J1])
    C_Y = pick @ jnp.kron(Cy, Cy) @ (pick + mirrored).T
    gain = Cp @ M.T @ jnp.linalg.inv(C_Y)
    p_new, Cp_new = p + gain @ (Y - Y_bar), Cp - gain @ M @ Cp
    return Belief(r_new, 0.5 * (Cr_new + Cr_new.T), p_new, 0.5 * (Cp_new + Cp_new.T))


def prepare(experiment: Experiment, scans: Scans) -> Prepared:
    """The filter on scans of some runs."""
    model, settings = EllipseModel.of(experiment), settings_of(experiment, "mem_ekf_star")
    Ch, shape_noise = model.extent_scale * jnp.eye(2), jnp.array(settings.shape_noise)

    def one(now: Belief, slot):
        y, seen = slot
        return where_each(seen, update_with_one(now, y, Ch, model.R), now), None

    def step(now: Belief, scan):
        r, Cr, p, Cp = now
        predicted = Belief(model.F @ r, model.F @ Cr @ model.F.T + model.Q, p, Cp + shape_noise)
        new, _ = jax.lax.scan(one, predicted, scan)
        return new, jnp.concatenate([new.r, jnp.abs(new.p[1:]), new.p[:1]])

    def track(mean: Float[Array, "4"], points: Float[Array, "step slot 2"], mask: Bool[Array, "step slot"]):
        shape = jnp.array([model.orientation, *model.semi_axes])
        start = Belief(mean, model.cov, shape, jnp.array(settings.shape_cov))
        return jax.lax.scan(step, start, (points, mask))[1]

    return over_runs(track, prior_means(experiment, scans), scans.points, scans.mask)

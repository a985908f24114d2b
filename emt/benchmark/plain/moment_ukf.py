"""Interacting image-moment filters, one straight and one turning, from the equations.

G. Yao, R. Saltus and A. Dani, IEEE Sensors J. 20 (2020), doi:10.1109/JSEN.2020.2976540: sigma points of the state and
all noises together, with a Cholesky factor for every point (Algorithm 1, eqs. 15-20), and the mixing of Algorithm 2.
This is `augmented: true` of emt's filter, which by default takes the sigma points of another root of the same
covariance. States are n11, n20, n02 (m²), x, vx, y, vy (m, m/s)[, turn rate (rad/s)]; moments are projected wherever
they are used, which the printed filter does without.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Bool, Float

from emt.benchmark.peers.base import Scans
from emt.benchmark.peers.models import prior_means, settings_of
from emt.benchmark.plain.base import EllipseModel, Prepared, over_runs, rotation, where_each
from emt.config.experiment import Experiment

JITTER = 1e-10
"""Variances of mixtures and predictions are enlarged by this fraction: a covariance may be singular."""
KINEMATIC = np.array([3, 5, 4, 6])
"""Rows of x, y, vx, vy."""


class Belief(NamedTuple):
    """State of a mode."""

    mean: Float[Array, "n"]
    cov: Float[Array, "n n"]


class Rules(NamedTuple):
    """What both modes share."""

    R: Float[Array, "2 2"]
    """Covariance of the sensor noise of a point (m²)."""
    gamma: float
    kappa: float
    beta: float
    """Constants of the scaled unscented transform."""
    floor: float
    """Least larger eigenvalue of the moments (m²)."""
    ratio: float
    """Least ratio of the smaller to the larger one."""
    dt: float


def jittered(cov: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The covariance with larger variances."""
    return cov + JITTER * jnp.diag(jnp.diag(cov))


def sigma_points(mean: Float[Array, "n"], cov: Float[Array, "n n"], rules: Rules):
    """Points as columns, and their weights in means and in covariances."""
    n = len(mean)
    c = rules.gamma**2 * (n + rules.kappa)
    root = jnp.linalg.cholesky(c * cov)
    w_mean = jnp.full(2 * n + 1, 0.5 / c).at[0].set(1.0 - n / c)
    w_cov = w_mean.at[0].add(1.0 - rules.gamma**2 + rules.beta)
    return jnp.concatenate([mean[:, None], mean[:, None] + root, mean[:, None] - root], axis=1), w_mean, w_cov


def project(state: Float[Array, "n"], rules: Rules) -> Float[Array, "n"]:
    """The state with the eigenvalues of its moments kept apart from zero; a circle stays one."""
    n11, n20, n02 = state[:3]
    center, half = 0.5 * (n20 + n02), 0.5 * (n20 - n02)
    radius = jnp.hypot(half, n11)
    larger = jnp.maximum(center + radius, rules.floor)
    smaller = jnp.where(radius > 0.0, jnp.maximum(center - radius, rules.ratio * larger), larger)
    # the same axes, other eigenvalues
    shrink = 0.5 * (larger - smaller) / jnp.where(radius > 0.0, radius, 1.0)
    center = 0.5 * (larger + smaller)
    return state.at[:3].set(jnp.array([shrink * n11, center + shrink * half, center - shrink * half]))


def squared_scale(state: Float[Array, "n"], z: Float[Array, "2"], rules: Rules) -> Float[Array, ""]:
    """q = 1/4 dᵀ N⁻¹ d: 1 on the ellipse through z, 0 at its centre."""
    n11, n20, n02 = project(state, rules)[:3]
    dx, dy = z[0] - state[3], z[1] - state[5]
    return 0.25 * (n02 * dx**2 - 2.0 * n11 * dx * dy + n20 * dy**2) / (n20 * n02 - n11**2)


def transform(now: Belief, z: Float[Array, "2"], rules: Rules):
    """Mean and variance of the pseudo-measurement 0 = q - s² - f of a point z, and the gain of the state."""
    mean, cov = now
    n, R = len(mean), rules.R
    n11, n20, n02 = project(mean, rules)[:3]
    M = 0.25 * jnp.linalg.inv(jnp.array([[n20, n11], [n11, n02]]))
    d = z - mean[jnp.array([3, 5])]
    f_mean, f_var = jnp.trace(M @ R), 2.0 * jnp.trace(M @ R @ M @ R) + 4.0 * d @ M @ R @ M @ d
    noise = jnp.diag(jnp.array([1.0 / 12.0, f_var]))
    points, w_mean, w_cov = sigma_points(
        jnp.concatenate([mean, jnp.array([0.5, f_mean])]), block_diag(cov, noise), rules
    )
    scales = jax.vmap(squared_scale, in_axes=(1, None, None))(points[:n], z, rules)
    values = scales - points[n] - points[n + 1]
    phi = w_mean @ values
    S = w_cov @ (values - phi) ** 2
    return phi, S, (points[:n] - mean[:, None]) @ (w_cov * (values - phi)) / S


def average_log_likelihood(
    now: Belief, points: Float[Array, "slot 2"], mask: Bool[Array, "slot"], rules: Rules
) -> Float[Array, ""]:
    """Of the points of a scan under the prediction; 0 without any."""
    phi, S, _ = jax.vmap(transform, in_axes=(None, 0, None))(now, points, rules)
    each = -0.5 * (phi**2 / S + jnp.log(2.0 * jnp.pi * S))
    return jnp.where(mask, each, 0.0).sum() / jnp.maximum(mask.sum(dtype=each.dtype), 1.0)


def update(now: Belief, points: Float[Array, "slot 2"], mask: Bool[Array, "slot"], rules: Rules) -> Belief:
    """By one point after the other."""

    def one(now: Belief, slot):
        z, seen = slot
        phi, S, K = transform(now, z, rules)
        new = Belief(project(now.mean - K * phi, rules), now.cov - S * jnp.outer(K, K))
        return where_each(seen, new, now), None

    return jax.lax.scan(one, now, (points, mask))[0]


def predict_straight(now: Belief, motion: Any, rules: Rules) -> Belief:
    """Kalman prediction with constant moments and velocity."""
    dt, axis = rules.dt, jnp.array([[1.0, rules.dt], [0.0, 1.0]])
    F = block_diag(jnp.eye(3), axis, axis)
    W = motion.psd * jnp.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    Q = block_diag(jnp.array(motion.moment_noise), W, W)
    return Belief(F @ now.mean, jittered(F @ now.cov @ F.T + Q))


def turned(state: Float[Array, "14"], dt: float) -> Float[Array, "8"]:
    """Coordinated turn with the noise of moments (3), accelerations (2) and turn acceleration."""
    n11, n20, n02, x, vx, y, vy, rate = state[:8]
    noise, half, a = state[8:], 0.5 * dt**2, rate * dt
    # sin a / rate and (1 - cos a) / rate, also at a rate of zero
    s, c = dt * jnp.sinc(a / jnp.pi), 0.5 * dt * a * jnp.sinc(0.5 * a / jnp.pi) ** 2
    L = rotation(a)
    N = L @ jnp.array([[n20, n11], [n11, n02]]) @ L.T
    v = L @ jnp.array([vx, vy])
    moved = jnp.array([N[0, 1], N[0, 0], N[1, 1], x + s * vx - c * vy, v[0], y + c * vx + s * vy, v[1], rate])
    gain = [half * noise[3], dt * noise[3], half * noise[4], dt * noise[4], dt * noise[5]]
    return moved + jnp.array([*noise[:3], *gain])


def predict_turn(now: Belief, motion: Any, rules: Rules) -> Belief:
    """Unscented prediction with all six noises among the sigma points."""
    variances = [motion.acceleration_variance, motion.acceleration_variance, motion.turn_acceleration_variance]
    noise = block_diag(jnp.array(motion.moment_noise), jnp.diag(jnp.array(variances)))
    points, w_mean, w_cov = sigma_points(jnp.concatenate([now.mean, jnp.zeros(6)]), block_diag(now.cov, noise), rules)
    moved = jax.vmap(turned, in_axes=(1, None), out_axes=1)(points, rules.dt)
    mean = moved @ w_mean
    gaps = moved - mean[:, None]
    return Belief(mean, jittered((w_cov[None, :] * gaps) @ gaps.T))


def merged(weights: Float[Array, "2"], straight: Belief, turning: Belief) -> Belief:
    """The mixture as one Gaussian with turn rate, which the straight mode knows to be zero."""
    means = jnp.stack([jnp.pad(straight.mean, (0, 1)), turning.mean])
    covs = jnp.stack([jnp.pad(straight.cov, (0, 1)), turning.cov])
    mean = weights @ means
    gaps = means - mean[None, :]
    return Belief(mean, (weights[:, None, None] * (covs + jax.vmap(jnp.outer)(gaps, gaps))).sum(axis=0))


def report(mean: Float[Array, "n"]) -> Float[Array, "7"]:
    """x, y, vx, vy, semi-axes, the major one first, and its direction."""
    n11, n20, n02 = mean[:3]
    center, radius = 0.5 * (n20 + n02), jnp.hypot(0.5 * (n20 - n02), n11)
    axes = 2.0 * jnp.sqrt(jnp.array([center + radius, center - radius]))
    return jnp.concatenate([mean[KINEMATIC], axes, 0.5 * jnp.arctan2(2.0 * n11, n20 - n02)[None]])


def prepare(experiment: Experiment, scans: Scans) -> Prepared:
    """The filter on scans of some runs.

    Raises:
        ValueError: the modes are not one straight and one turning that are alike otherwise, weighed by the average
            likelihood.
    """
    model, settings = EllipseModel.of(experiment), settings_of(experiment, "imm")
    (cv, ct), prior = settings.modes.values(), experiment.model.prior
    kinds = [mode.motion.kind for mode in (cv, ct)]
    alike = ct.model_copy(update={"motion": cv.motion}) == cv
    if kinds != ["constant_velocity", "coordinated_turn"] or not alike or cv.projection is None:
        raise ValueError("the plain form knows one straight and one turning mode that project alike")
    if settings.likelihood != "average" or settings.start is not None:
        raise ValueError("the plain form weighs by the average likelihood, modes that are equally probable at first")
    bounds, transition = cv.projection, jnp.array(settings.transition)
    rules = Rules(model.R, cv.gamma, cv.kappa, cv.beta, bounds.floor, bounds.ratio, experiment.scenario.dt)

    def start(mean: Float[Array, "4"]) -> tuple[Belief, Belief]:
        L = rotation(jnp.array(model.orientation))
        N = 0.25 * L @ jnp.diag(model.semi_axes**2) @ L.T
        first = jnp.zeros(8).at[:3].set(jnp.array([N[0, 1], N[0, 0], N[1, 1]])).at[KINEMATIC].set(mean)
        cov = jnp.zeros((8, 8)).at[:3, :3].set(jnp.array(cv.moment_cov))
        cov = cov.at[KINEMATIC[:, None], KINEMATIC[None, :]].set(model.cov)
        first, cov = first.at[7].set(prior.turn_rate), cov.at[7, 7].set(prior.turn_rate_variance)
        return Belief(first[:7], jittered(cov[:7, :7])), Belief(first, jittered(cov))

    def step(now, scan: tuple[jax.Array, jax.Array]):
        ((straight, turning), mu), (points, mask) = now, scan
        joint = mu[:, None] * transition
        mu = joint.sum(axis=0)
        to_straight = merged(joint[:, 0] / mu[0], straight, turning)
        to_turning = merged(joint[:, 1] / mu[1], straight, turning)
        straight = Belief(to_straight.mean[:7], jittered(to_straight.cov[:7, :7]))
        turning = Belief(to_turning.mean, jittered(to_turning.cov))
        predicted = predict_straight(straight, cv.motion, rules), predict_turn(turning, ct.motion, rules)
        gains = jnp.stack([average_log_likelihood(mode, points, mask, rules) for mode in predicted])
        straight, turning = (update(mode, points, mask, rules) for mode in predicted)
        mu = mu * jnp.exp(gains)
        mu = mu / mu.sum()
        return ((straight, turning), mu), report(merged(mu, straight, turning).mean)

    def track(mean: Float[Array, "4"], points: Float[Array, "step slot 2"], mask: Bool[Array, "step slot"]):
        return jax.lax.scan(step, (start(mean), jnp.array([0.5, 0.5])), (points, mask))[1]

    return over_runs(track, prior_means(experiment, scans), scans.points, scans.mask)

"""Interacting image-moment filters, all runs and both modes at once (see `tests.reference.moment_square_root`).

G. Yao, R. Saltus and A. Dani, IEEE Sensors J. 20 (2020). States (8, mode, run), square roots (8, 8, mode, run), sigma
points (.., 17, mode, run). The straight mode has a turn rate of zero that it knows exactly: its two sigma points lie on
the centre and add nothing, and the step is that of seven states. The points of a scan come one after the other, so runs
are sorted by the number of their points: those that still have one are the first ones, a slice of every array.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference.batched import plane
from tests.reference.batched.cholesky import cholesky
from tests.reference.batched.points import counts_of, points_about
from tests.reference.moment_square_root import JITTER, KINEMATIC, Rules, Straight, Turning, started
from tests.reference.worlds import EllipseWorld

Array = NDArray[np.float64]
PLACED = np.array([0, 1, 2, 3, 5])
"""Rows of the moments and of the position."""


class Belief(NamedTuple):
    """Gaussians of both modes: means (8, mode, run), and square roots of covariances (8, 8, mode, run)."""

    mean: Array
    root: Array

    def first(self, n: int) -> "Belief":
        """That of the first runs."""
        return Belief(self.mean[..., :n], self.root[..., :n])

    def take(self, order: NDArray[np.int64]) -> "Belief":
        """The runs in another order; `take` keeps them contiguous, which an index need not."""
        return Belief(self.mean.take(order, axis=-1), self.root.take(order, axis=-1))


def jittered(cov: Array) -> Array:
    """The covariance with its variances enlarged a little, in place."""
    diagonal = np.einsum("ii...->i...", cov)
    diagonal *= 1.0 + JITTER
    return cov


def project(moments: Array, rules: Rules) -> None:
    """Projects moments n11, n20, n02 (3, ...) in place.

    Eigenvalues of sum t and product d comply if d >= ratio / (1 + ratio)^2 t^2 and, certainly, if t is twice the floor;
    only the others are taken apart.
    """
    n11, n20, n02 = moments
    t = n20 + n02
    comply = n20 * n02 - n11 * n11 >= (rules.ratio / (1.0 + rules.ratio) ** 2) * t * t
    comply &= t >= 2.0 * rules.floor
    if comply.all():
        return
    places = np.nonzero(~comply)
    n11, n20, n02 = (entry[places] for entry in moments)
    mean, half = 0.5 * (n20 + n02), 0.5 * (n20 - n02)
    radius = np.sqrt(half * half + n11 * n11)
    larger = np.maximum(mean + radius, rules.floor)
    smaller = np.where(radius > 0.0, np.maximum(mean - radius, rules.ratio * larger), larger)
    acts = (larger != mean + radius) | (smaller != mean - radius)
    shrink = 0.5 * (larger - smaller) / np.where(radius > 0.0, radius, 1.0)
    centre = 0.5 * (larger + smaller)
    moments[0][places] = np.where(acts, shrink * n11, n11)
    moments[1][places] = np.where(acts, centre + shrink * half, n20)
    moments[2][places] = np.where(acts, centre - shrink * half, n02)


class Seen(NamedTuple):
    """What a belief expects of any point: all that does not depend on the point."""

    quarter: Array
    """N^-1 / 4 of the sigma points, entries xx, yy, xy (3, 17, mode, run)."""
    position: Array
    """Of the sigma points (2, 17, mode, run)."""
    pulled: Array
    """M R M with M that of the mean (3, mode, run)."""
    mean: Array
    variance: Array
    """Of f and s^2, but for the part of the variance that depends on the point (mode, run)."""

    def first(self, n: int) -> "Seen":
        """That of the first runs."""
        return Seen(*(part[..., :n] for part in self))


def squared_steps(rules: Rules) -> Array:
    """Of the sigma points of both modes (mode, 1), in the space of the state, s^2 and f."""
    return np.array([[rules.squared_step(7 + 2)], [rules.squared_step(8 + 2)]])


def seen_by(belief: Belief, R: Array, rules: Rules) -> Seen:
    """Sigma points of a belief, of which only moments and position are needed; R (3, 1, 1) noise covariance."""
    step = np.sqrt(squared_steps(rules)) * belief.root[PLACED]
    mean = belief.mean[PLACED][:, None]
    states = np.empty((5, 17, *belief.mean.shape[1:]))
    states[:, :1] = mean
    np.add(mean, step, out=states[:, 1:9])
    np.subtract(mean, step, out=states[:, 9:])
    project(states[:3], rules)
    n11, n20, n02 = states[:3]
    share = n20 * n02
    share -= n11 * n11
    np.divide(0.25, share, out=share)
    quarter = np.empty_like(states[:3])
    np.multiply(states[1:3], share, out=quarter[1::-1])
    np.multiply(n11, -share, out=quarter[2])
    M = quarter[:, 0]
    pulled = plane.sandwich(M, R)
    return Seen(quarter, states[3:], pulled, 0.5 + plane.inner(M, R), 1.0 / 12.0 + 2.0 * plane.inner(pulled, R))


def quadratic(s: Array, v: Array) -> Array:
    """v^T S v."""
    cross = v[0] * v[1]
    cross *= s[2]
    cross += cross
    squares = v * v
    squares *= s[:2]
    cross += squares[0]
    cross += squares[1]
    return cross


def expected(seen: Seen, z: Array, rules: Rules) -> tuple[Array, Array, Array]:
    """Mean and variance (mode, run) of the pseudo-measurement of points z (2, run), and u (8, mode, run) such that
    root @ u is its covariance with the state."""
    offset = z[:, None, None] - seen.position
    values = quadratic(seen.quarter, offset)
    c = squared_steps(rules)
    center, gaps = values[0], values[1:]
    gaps -= center
    bend = gaps.sum(axis=0)
    bend *= 0.5 / c
    u = gaps[:8] - gaps[8:]
    u *= 0.5 / np.sqrt(c)
    variance = np.einsum("kmr,kmr->mr", gaps, gaps)
    variance *= 0.5 / c
    variance += (rules.beta - rules.gamma**2) * bend * bend
    variance += 4.0 * quadratic(seen.pulled, offset[:, 0])
    variance += seen.variance
    bend += center
    bend -= seen.mean
    return bend, variance, u


def update_with_one(belief: Belief, z: Array, R: Array, rules: Rules) -> None:
    """Update in place with one point z (2, run) of every run."""
    phi, S, u = expected(seen_by(belief, R, rules), z, rules)
    gain = np.einsum("ijmr,jmr->imr", belief.root, u)
    rest = np.sqrt(np.maximum(1.0 - np.einsum("jmr,jmr->mr", u, u) / S, 0.0))
    belief.mean[:] -= gain * (phi / S)
    project(belief.mean[:3], rules)
    gain /= S * (1.0 + rest)
    belief.root[:] -= gain[:, None] * u


def update(belief: Belief, points: Array, left: NDArray[np.int64], R: Array, rules: Rules) -> Array:
    """Update in place with all points (2, slot, run) in their order, of the first `left` (slot,) runs each.

    Returns the sum of the log-likelihoods of the points under the prediction (mode, run).
    """
    total, seen = np.zeros(belief.mean.shape[1:]), seen_by(belief, R, rules)
    for j, n in enumerate(left):
        phi, S, _ = expected(seen.first(n), points[:, j, :n], rules)
        total[:, :n] -= 0.5 * (phi * phi / S + np.log(2.0 * np.pi * S))
    for j, n in enumerate(left):
        update_with_one(belief.first(n), points[:, j, :n], R, rules)
    return total


def predict_straight(mean: Array, cov: Array, mode: Straight, rules: Rules) -> tuple[Array, Array]:
    """Kalman prediction of means (7, run) and covariances (7, 7, run), both of which it changes; a square root."""
    dt = rules.dt
    jittered(cov)
    for place in (3, 5):
        mean[place] += dt * mean[place + 1]
        cov[place] += dt * cov[place + 1]
        cov[:, place] += dt * cov[:, place + 1]
        cov[place, place] += mode.psd * dt**3 / 3.0
        cov[place, place + 1] += mode.psd * dt**2 / 2.0
        cov[place + 1, place] += mode.psd * dt**2 / 2.0
        cov[place + 1, place + 1] += mode.psd * dt
    cov[:3, :3] += mode.moment_noise[:, :, None]
    return mean, cholesky(jittered(cov))


def turned(states: Array, dt: float) -> Array:
    """Coordinated turn of states (8, k, run)."""
    n11, n20, n02, x, vx, y, vy, rate = states
    angle = dt * rate
    t = np.tan(0.5 * angle)
    share = 1.0 / (1.0 + t * t)
    s = 2.0 * t * share
    c = 1.0 - t * s
    along = dt * np.divide(s, angle, out=np.ones_like(s), where=angle != 0.0)
    across = along * t
    c2, s2 = (c - s) * (c + s), 2.0 * c * s
    mean, half = 0.5 * (n20 + n02), 0.5 * (n20 - n02)
    bent = c2 * half - s2 * n11
    out = np.empty_like(states)
    np.add(c2 * n11, s2 * half, out=out[0])
    np.add(mean, bent, out=out[1])
    np.subtract(mean, bent, out=out[2])
    np.add(x, along * vx - across * vy, out=out[3])
    np.subtract(c * vx, s * vy, out=out[4])
    np.add(y, across * vx + along * vy, out=out[5])
    np.add(s * vx, c * vy, out=out[6])
    out[7] = rate
    return out


def predict_turn(mean: Array, cov: Array, mode: Turning, rules: Rules) -> tuple[Array, Array]:
    """Unscented prediction of means (8, run) and covariances (8, 8, run); a square root."""
    dt, c = rules.dt, rules.squared_step(8 + 6)
    step = np.sqrt(c) * cholesky(jittered(cov))
    center = mean[:, None]
    moved = turned(np.concatenate([center, center + step, center - step], axis=1), dt)
    center, gaps = moved[:, 0], moved[:, 1:]
    gaps -= center[:, None]
    bend = gaps.sum(axis=1)
    bend *= 0.5 / c
    new = np.einsum("ikr,jkr->ijr", gaps, gaps)
    new *= 0.5 / c
    new += (rules.beta - rules.gamma**2) * bend[:, None] * bend
    new[:3, :3] += mode.moment_noise[:, :, None]
    W = mode.acceleration_variance * np.outer([dt**2 / 2.0, dt], [dt**2 / 2.0, dt])
    new[3:5, 3:5] += W[:, :, None]
    new[5:7, 5:7] += W[:, :, None]
    new[7, 7] += mode.turn_acceleration_variance * dt**2
    return center + bend, cholesky(jittered(new))


def mixed(weights: Array, means: Array, covs: Array) -> tuple[Array, Array]:
    """Mean (n, run) and covariance (n, n, run) of both modes, of weights (2, run): the spread of the means is w1 w2
    times the square of their difference."""
    first, second = weights
    gap = means[:, 1] - means[:, 0]
    cov = first * covs[:, :, 0]
    cov += second * covs[:, :, 1]
    cov += (first * second * gap)[:, None] * gap
    return means[:, 0] + second * gap, cov


def track(
    points: Array, mask: NDArray[np.bool_], world: EllipseWorld, moment_cov: Array, straight: Straight,
    turning: Turning, transition: Array, rules: Rules,
) -> Array:  # fmt: skip
    """Reports (run, step, 7) of x, y, vx, vy, both semi-axes and the orientation, from points (run, step, slot, 2).

    moment_cov (3, 3) prior covariance of the moments; transition [i, j] probability of mode j next, given i now. Both
    modes are equally probable at the start.
    """
    runs, n_steps = mask.shape[:2]
    counts = counts_of(mask)
    R = plane.entries(rules.noise_cov)[:, None]
    mean, cov = started(world, moment_cov)
    # the straight mode knows its turn rate, which is zero
    means, covs = np.tile(mean[:, None, None], (2, runs)), np.tile(cov[:, :, None, None], (2, runs))
    means[7, 0], covs[7, :, 0], covs[:, 7, 0] = 0.0, 0.0, 0.0
    jittered(covs)
    mu = np.full((2, runs), 0.5)
    belief = Belief(np.zeros_like(means), np.zeros_like(covs))
    reports = np.empty((n_steps, 7, runs))
    for k in range(n_steps):
        joint = mu[:, None] * transition[:, :, None]
        mu = joint.sum(axis=0)
        weights = joint / mu
        ahead = mixed(weights[:, 0], means[:7], covs[:7, :7])
        belief.mean[:7, 0], belief.root[:7, :7, 0] = predict_straight(*ahead, straight, rules)
        ahead = mixed(weights[:, 1], means, covs)
        belief.mean[:, 1], belief.root[:, :, 1] = predict_turn(*ahead, turning, rules)

        now = counts[:, k]
        order = np.argsort(-now, kind="stable")
        back = np.argsort(order)
        about = points_about(points[:, k], now, np.zeros((2, runs))).take(order, axis=-1)
        left = np.count_nonzero(np.arange(about.shape[1])[:, None] < now, axis=1)
        in_order = belief.take(order)
        log_likelihood = update(in_order, about, left, R, rules).take(back, axis=-1)
        means, root = in_order.take(back)
        covs = np.einsum("ijmr,kjmr->ikmr", root, root)

        log_likelihood /= np.maximum(now, 1)
        mu = mu * np.exp(log_likelihood - log_likelihood.max(axis=0))
        mu /= mu.sum(axis=0)
        overall = (mu * means).sum(axis=1)
        reports[k, :4] = overall[KINEMATIC]
        reports[k, 4:6], reports[k, 6] = ellipse_read_out(overall)
    return reports.transpose(2, 0, 1)


def ellipse_read_out(mean: Array) -> tuple[Array, Array]:
    """Semi-axes (2, run) [length], the major one first, and its direction (run,) [rad] in (-pi/2, pi/2]."""
    n11, n20, n02 = mean[:3]
    centre, half = 0.5 * (n20 + n02), 0.5 * (n20 - n02)
    larger = centre + np.sqrt(half * half + n11 * n11)
    # the product of the eigenvalues keeps the digits of the smaller one
    squares = np.stack([larger, (n20 * n02 - n11 * n11) / larger])
    return 2.0 * np.sqrt(squares), 0.5 * np.arctan2(n11, half)

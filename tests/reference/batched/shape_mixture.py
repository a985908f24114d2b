"""Interacting shape models of the arm, all runs at once (see `tests.reference.shape_mixture`).

A. Zea, F. Faion and U. D. Hanebeck 2014. The state is (l_a, α_a, ω_a, l_b, α_b, ω_b, α_c, ω_c); means (8, run),
covariances (8, 8, run), samples (32, run). All segments share the samples of the state, and the chain is followed in
the frames of its links, so that three angles are turned into sines and cosines. A disc's update is the identity.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference.batched import plane
from tests.reference.batched.cholesky import cholesky
from tests.reference.batched.trigonometry import sincos_of_double
from tests.reference.shape_mixture import FINGER, RADIUS

Array = NDArray[np.float64]
ANGLES = (1, 4, 6)
"""Places in the state, each followed by its rate."""
PLACING = np.array([0, 1, 3, 4, 6])
"""Places of what the segments depend on: lengths and angles."""


class Evidence(NamedTuple):
    """What the four segments make of a point: moments of the pseudo-measurement h, residuals along and across."""

    h: Array
    """Mean (2, 4, run)."""
    inverse: Array
    """Inverse covariance, entries xx, yy, xy (3, 4, run)."""
    cross: Array
    """Covariance with the state (2, 4, 8, run)."""
    log_density: Array
    """Per area (4, run)."""


def predict(mean: Array, cov: Array, q: Array, dt: float) -> None:
    """Time update in place: angles by their rates; q (8, 1) variances of the noise."""
    for angle in ANGLES:
        mean[angle] += dt * mean[angle + 1]
        cov[angle] += dt * cov[angle + 1]
        cov[:, angle] += dt * cov[:, angle + 1]
    variances = np.einsum("iir->ir", cov)
    variances += q


def residuals(states: Array, y: Array, shares: Array) -> Array:
    """h = [l s; 0] - R(β)^T (y - p) of the four segments, (2, 4, sample, run).

    states (5, sample, run) as in `PLACING`, y (2, run), shares (sample, 1) of the lengths.
    """
    l_a, half_a, l_b, half_b, quarter_c = states[0], 0.5 * states[1], states[2], 0.5 * states[3], 0.25 * states[4]
    h = np.empty((2, 4, *l_a.shape))

    def place(k: int, length: Array | float, along: Array, across: Array) -> None:
        np.subtract(length * shares, along, out=h[0, k])
        np.negative(across, out=h[1, k])

    sin, cos = sincos_of_double(half_a)
    along, across = cos * y[0] + sin * y[1], cos * y[1] - sin * y[0]
    place(0, l_a, along, across)
    # from the elbow, in the frame of the forearm, which is turned by α_b - π
    sin, cos = sincos_of_double(half_b)
    along -= l_a
    along, across = -cos * along - sin * across, sin * along - cos * across
    place(1, l_b, along, across)
    # from the hand, turned by half of α_c to either side
    sin, cos = sincos_of_double(quarter_c)
    along -= l_b
    turned, kept = sin * across, cos * along
    place(2, FINGER, kept + turned, cos * across - sin * along)
    place(3, FINGER, kept - turned, cos * across + sin * along)
    return h


def evidence(mean: Array, cov: Array, y: Array, sigma2: float, samples: Array) -> Evidence:
    """Sampling updates of all segments by the point y (2, run); samples (sample, 9) of state and place, sigma2 the
    noise variance."""
    unit, shares = samples[:, :8], 0.5 + samples[:, 8:] / np.sqrt(12.0)
    root = cholesky(cov)
    states = unit @ root[PLACING]
    states += mean[PLACING][:, None]
    gaps = residuals(states, y, shares)
    h = gaps.mean(axis=2)
    gaps -= h[:, :, None]
    spread = np.empty((3, *h.shape[1:]))
    np.einsum("kcsr,kcsr->kcr", gaps, gaps, out=spread[:2])
    np.einsum("csr,csr->cr", gaps[0], gaps[1], out=spread[2])
    spread /= len(samples)
    spread[:2] += sigma2
    cross = np.einsum("ijr,kcjr->kcir", root, (unit.T / len(samples)) @ gaps)
    det = plane.det(spread)
    inverse = plane.inverse(spread, det)
    distance = plane.dot(h, plane.apply(inverse, h))
    return Evidence(h, inverse, cross, -0.5 * (distance + np.log(det)) - np.log(2.0 * np.pi))


def disc_log_density(y: Array, sigma2: float) -> Array:
    """Log density per area (run,) of points under the hub."""
    h = plane.dot(y, y) - RADIUS**2 / 2.0 - 2.0 * sigma2
    variance = RADIUS**4 / 12.0 + 4.0 * sigma2**2 + 2.0 * sigma2 * RADIUS**2
    return -0.5 * (h * h / variance + np.log(2.0 * np.pi * variance)) - np.log(np.pi)


def update(mean: Array, cov: Array, y: Array, sigma2: float, samples: Array) -> None:
    """Update in place by the mixture of all five components, equally probable before.

    With X the cross covariance, C and h covariance and mean of a pseudo-measurement and d = -X C^-1 h, an update is
    (x + d, P - X C^-1 X^T); the mixture has mean x + Σ w d and covariance
    P + Σ w X (C^-1 h h^T C^-1 - C^-1) X^T - (Σ w d)(Σ w d)^T.
    """
    found = evidence(mean, cov, y, sigma2, samples)
    logs = np.concatenate([disc_log_density(y, sigma2)[None], found.log_density])
    weights = np.exp(logs - logs.max(axis=0))
    weights /= weights.sum(axis=0)
    weights = weights[1:]
    pull = plane.apply(found.inverse, found.h)
    shift = -np.einsum("kcir,kcr->ir", found.cross, weights * pull)
    inner = plane.outer(pull)
    inner -= found.inverse
    inner *= weights
    first, second = found.cross
    left = np.empty_like(found.cross)
    np.add(inner[0][:, None] * first, inner[2][:, None] * second, out=left[0])
    np.add(inner[2][:, None] * first, inner[1][:, None] * second, out=left[1])
    cov += np.einsum("kcir,kcjr->ijr", left, found.cross)
    cov -= shift[:, None] * shift
    mean += shift


def track(
    points: Array, mask: NDArray[np.bool_], mean: Array, cov: Array, sigma2: float, q: Array, dt: float, samples: Array
) -> Array:  # fmt: skip
    """Means (run, step, 8), from one point per scan, points (run, step, 1, 2); mean (8,) and cov (8, 8) the prior.

    q (8,) variances of the process noise, samples (sample, 9) of a standard normal density.

    Raises:
        ValueError: a scan is empty.
    """
    if not mask.all():
        raise ValueError("every scan must hold a point")
    runs, n_steps = mask.shape[:2]
    mean, cov = np.tile(mean[:, None], runs), np.tile(cov[:, :, None], runs)
    reports = np.empty((n_steps, 8, runs))
    for k in range(n_steps):
        predict(mean, cov, q[:, None], dt)
        update(mean, cov, np.ascontiguousarray(points[:, k, 0].T), sigma2, samples)
        reports[k] = mean
    return reports.transpose(2, 0, 1)

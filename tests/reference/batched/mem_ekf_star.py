"""The MEM-EKF* ellipse tracker, all runs at once (see `tests.reference.mem_ekf_star`).

S. Yang and M. Baum, IEEE Trans. Signal Process. 67 (2019) 4720-4729. The points of a scan come one after the other, so
runs are sorted by the number of their points: those that still have one are the first ones, a slice of every array.
An update takes the pseudo-measurement in the frame of the predicted axes, which is a linear change of its coordinates
and alters no gain. There M is diagonal, and C_Y^-1 and C_Y^-1 (Y - Y_bar) are products of entries of W = C_y^-1 and
W e.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference.batched import kinematics, plane
from tests.reference.batched.points import counts_of, points_about
from tests.reference.batched.trigonometry import sincos_of_double
from tests.reference.worlds import EllipseWorld

Array = NDArray[np.float64]


class Belief(NamedTuple):
    """What the runs believe of position and shape during a scan; updated in place."""

    position: Array
    C: Array
    """Relative to the predicted position: mean (2, run) and covariance (3, run)."""
    p: Array
    """Orientation [rad] and semi-axes [length] (3, run)."""
    Cp: Array
    """Their covariance (3, 3, run)."""


def turned(s: Array, cos2: Array, sin2: Array) -> Array:
    """L^T S L for a rotation L whose double angle has this cosine and sine."""
    mean, half = 0.5 * (s[0] + s[1]), 0.5 * (s[0] - s[1])
    along = half * cos2
    along += s[2] * sin2
    out = np.empty_like(s)
    np.add(mean, along, out=out[0])
    np.subtract(mean, along, out=out[1])
    np.subtract(s[2] * cos2, half * sin2, out=out[2])
    return out


def update_with_one(belief: Belief, y: Array, k: float, R: Array) -> None:
    """Update with one point y (2, run) of every run; k the extent scale, R (3, 1) the noise covariance."""
    position, C, p, Cp = belief
    l1, l2 = p[1], p[2]
    sin, cos = sincos_of_double(0.5 * p[0])
    cos2, sin2 = (cos - sin) * (cos + sin), 2.0 * sin * cos

    # C_y = H C H^T + R + C_I + C_II in the frame of the axes.
    squares = p[1:] * p[1:]
    spread = squares + squares[::-1] * Cp[0, 0]
    spread[0] += Cp[1, 1]
    spread[1] += Cp[2, 2]
    Cy = turned(C + R, cos2, sin2)
    Cy[:2] += k * spread
    Cy[2] += k * (l1 * Cp[0, 1] - l2 * Cp[0, 2])
    w = plane.inverse(Cy)
    e = y - position
    along = np.empty_like(e)
    np.add(cos * e[0], sin * e[1], out=along[0])
    np.subtract(cos * e[1], sin * e[0], out=along[1])
    f = plane.apply(w, along)

    # Position.
    force = np.empty_like(e)
    np.subtract(cos * f[0], sin * f[1], out=force[0])
    np.add(sin * f[0], cos * f[1], out=force[1])
    position += plane.apply(C, force)
    C -= plane.sandwich(C, turned(w, cos2, -sin2))

    # Shape: C_p M^T, C_Y^-1 (Y - Y_bar) and C_Y^-1, for pseudo-measurements e1 e2, e1^2 / 2 and e2^2 / 2.
    M = np.empty_like(p)
    np.subtract(squares[0], squares[1], out=M[0])
    M[1:] = p[1:]
    M *= k
    cross = Cp * M
    excess = plane.outer(f)
    excess -= w
    pairs = w[:, None] * w
    C_Y_inv = np.empty_like(Cp)
    np.add(pairs[0, 1], pairs[2, 2], out=C_Y_inv[0, 0])
    np.multiply(pairs[2, :2], 2.0, out=C_Y_inv[0, 1:])
    C_Y_inv[1:, 0] = C_Y_inv[0, 1:]
    C_Y_inv[1, 1], C_Y_inv[2, 2], C_Y_inv[1, 2] = pairs[0, 0], pairs[1, 1], pairs[2, 2]
    C_Y_inv[2, 1] = pairs[2, 2]
    C_Y_inv[1:, 1:] *= 2.0
    p += np.einsum("ijr,jr->ir", cross, excess[[2, 0, 1]])
    Cp -= np.einsum("ijr,kjr->ikr", np.einsum("ijr,kjr->ikr", cross, C_Y_inv), cross)


def update(
    mean: Array, cov: Array, p: Array, Cp: Array, points: Array, counts: NDArray[np.int64], k: float, R: Array
) -> None:  # fmt: skip
    """Measurement update in place with all points of a scan in their order.

    mean and cov kinematics as in `kinematics`; p (3, run) and Cp (3, 3, run) the shape; points (run, slot, 2), of which
    the first `counts` (run,) are real; k the extent scale, R (2, 2) the noise covariance.
    """
    order = np.argsort(-counts, kind="stable")
    about = points_about(points, counts, mean[:2]).take(order, axis=-1)
    # `take` keeps runs contiguous, which an index need not
    parts = (cov[kinematics.POSITION], p, Cp)
    belief = Belief(np.zeros((2, len(order))), *(part.take(order, axis=-1) for part in parts))
    noise = plane.entries(R)
    left = np.count_nonzero(np.arange(about.shape[1])[:, None] < counts, axis=1)
    for j, n in enumerate(left):
        update_with_one(Belief(*(part[..., :n] for part in belief)), about[:, j, :n], k, noise)

    back = np.argsort(order)
    position, C, p[:], Cp[:] = (part.take(back, axis=-1) for part in belief)
    kinematics.regress(mean, cov, position, C)


def track(
    points: Array, mask: NDArray[np.bool_], world: EllipseWorld, shape_cov: Array, shape_noise: Array
) -> Array:  # fmt: skip
    """Reports (run, step, 7) of x, y, vx, vy, both semi-axes and the orientation, from points (run, step, slot, 2).

    shape_cov, shape_noise (3, 3) prior covariance of orientation and semi-axes, and what is added to it per step.
    """
    runs, n_steps = mask.shape[:2]
    counts = counts_of(mask)
    noise = kinematics.white_acceleration(world.psd, world.dt)
    mean = np.tile(world.mean[:, None], runs)
    cov = np.tile(kinematics.blocks(world.cov)[:, None], runs)
    p = np.tile(np.array([world.orientation, *world.semi_axes])[:, None], runs)
    Cp = np.tile(shape_cov[:, :, None], runs)
    reports = np.empty((n_steps, 7, runs))
    for step in range(n_steps):
        kinematics.predict(mean, cov, world.dt, noise)
        Cp += shape_noise[:, :, None]
        update(mean, cov, p, Cp, points[:, step], counts[:, step], world.extent_scale, world.noise_cov)
        reports[step, :4] = mean
        np.abs(p[1:], out=reports[step, 4:6])
        reports[step, 6] = p[0]
    return reports.transpose(2, 0, 1)

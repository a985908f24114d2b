"""The workloads of the benchmark in plain NumPy, in two forms: one run after the other, and all runs at once.

The first form is a loop over runs and steps about the textbook's functions in this folder; the second is
`tests.reference.batched`, the same equations on arrays with an axis for the runs. Both read the settings of the
experiments in `configs/benchmark` and the scans that were simulated for them, and report what the filters report.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emt.config.experiment import Experiment
from tests.reference import (
    batched,
    mem_ekf_star,
    moment_square_root,
    moment_ukf,
    multiple_model,
    particle_cloud,
    shape_mixture,
    vb,
)
from tests.reference.settings import connected_world, ellipse_world, moment_modes, point_world, range_bearing_world

Array = NDArray[np.float64]
PARTICLE_SEED = 20260101
"""Of the particles' random numbers, which are others than those of the filter."""
PARTICLE_RUNS = 26
"""Runs at once of the particle filter: the particles of more of them do not fit the cache."""


class Scans(NamedTuple):
    """Measurements of several runs, and what the filters are told of each run."""

    points: Array
    """(run, step, slot, m), the real ones of a scan in its first slots; the others hold any finite numbers."""
    mask: NDArray[np.bool_]
    """(run, step, slot), true where a measurement is."""
    prior_mean: Array | None = None
    """Mean of the prior (run, n), where each run has its own."""


class Reference(NamedTuple):
    """A workload in NumPy."""

    per_run: Callable[[Experiment, Scans], Array]
    """Reports (run, step, k), by a loop over runs and steps: x, y, vx, vy, both semi-axes and the orientation of
    ellipses, else the mean of the state."""
    batched: Callable[[Experiment, Scans], Array]
    """The same with all runs at once."""
    exact: bool
    """Whether the reports are those of the filter but for rounding; if not, its random numbers are others, and the
    reports are alike in distribution."""


def run_by_run(track: Callable[[list[Array]], list[Array]], scans: Scans) -> Array:
    """Reports of every run in turn; `track` takes the real points (n, m) of each scan."""
    rows = zip(scans.points, scans.mask, strict=True)
    return np.array([track([p[seen] for p, seen in zip(points, mask, strict=True)]) for points, mask in rows])


def vb_per_run(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.vb`."""
    world, settings = ellipse_world(experiment), experiment.filters["vb"]
    (F, Q), a = world.motion(), np.array(settings.shape)

    def track(points: list[Array]) -> list[Array]:
        b, rows = (a - 1.0) * world.semi_axes**2, []
        state = (world.mean, world.cov, world.orientation, settings.orientation_variance, a, b)
        for y in points:
            state = vb.predict(*state, F, Q, settings.orientation_noise, settings.forgetting)
            state = vb.update(*state, y, world.noise_cov, world.extent_scale, settings.iterations)
            rows.append(np.array([*state[0], *vb.semi_axes(*state[4:]), state[2]]))
        return rows

    return run_by_run(track, scans)


def vb_batched(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.batched.vb`."""
    settings = experiment.filters["vb"]
    return batched.vb.track(
        scans.points, scans.mask, ellipse_world(experiment), np.array(settings.shape), settings.orientation_variance,
        settings.orientation_noise, settings.forgetting, settings.iterations,
    )  # fmt: skip


def mem_per_run(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.mem_ekf_star`."""
    world, settings = ellipse_world(experiment), experiment.filters["mem_ekf_star"]
    (F, Q), noise = world.motion(), np.array(settings.shape_noise)
    shape = np.array([world.orientation, *world.semi_axes])

    def track(points: list[Array]) -> list[Array]:
        state, rows = (world.mean, world.cov, shape, np.array(settings.shape_cov)), []
        for y in points:
            state = mem_ekf_star.predict(*state, F, Q, noise)
            state = mem_ekf_star.update(*state, y, world.extent_scale * np.eye(2), world.noise_cov)
            angle, axes = mem_ekf_star.ellipse_read_out(state[2])
            rows.append(np.array([*state[0], *axes, angle]))
        return rows

    return run_by_run(track, scans)


def mem_batched(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.batched.mem_ekf_star`."""
    settings = experiment.filters["mem_ekf_star"]
    return batched.mem_ekf_star.track(
        scans.points, scans.mask, ellipse_world(experiment), np.array(settings.shape_cov),
        np.array(settings.shape_noise),
    )  # fmt: skip


def moments_per_run(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.moment_square_root`, and the mixing of `tests.reference.moment_ukf`."""
    world, modes = ellipse_world(experiment), moment_modes(experiment)
    (mean, cov), rules = moment_square_root.started(world, modes.moment_cov), modes.rules

    def track(points: list[Array]) -> list[Array]:
        mu, found = np.full(2, 0.5), []
        states = [(mean[:n], moment_square_root.root_of(cov[:n, :n])) for n in (7, 8)]
        for y in points:
            joint = mu[:, None] * modes.transition
            mu = joint.sum(axis=0)
            means, covs = [x for x, _ in states], [root @ root.T for _, root in states]
            mixed = [moment_ukf.merge(joint[:, j] / mu[j], means, covs, 7 + j) for j in range(2)]
            straight, turning = ((x, moment_square_root.root_of(P)) for x, P in mixed)
            predicted = [
                moment_square_root.predict_straight(*straight, modes.straight, rules),
                moment_square_root.predict_turn(*turning, modes.turning, rules),
            ]
            results = [moment_square_root.update(*state, y, rules) for state in predicted]
            states = [(x, root) for x, root, _ in results]
            mu = mu * np.exp([average for *_, average in results])
            mu = mu / mu.sum()
            overall = mu[0] * states[0][0] + mu[1] * states[1][0][:7]
            axes, angle = moment_square_root.ellipse_read_out(overall)
            found.append(np.array([*overall[moment_square_root.KINEMATIC], *axes, angle]))
        return found

    return run_by_run(track, scans)


def moments_batched(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.batched.moment_ukf`."""
    return batched.moment_ukf.track(scans.points, scans.mask, ellipse_world(experiment), *moment_modes(experiment))


def imm_per_run(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.multiple_model`."""
    world = point_world(experiment)
    F, G = np.kron([[1.0, world.dt], [0.0, 1.0]], np.eye(2)), np.kron([[0.5 * world.dt**2], [world.dt]], np.eye(2))
    models = [(F, G @ a, q * G @ G.T) for a, q in zip(world.accelerations, world.variances, strict=True)]
    n, H, rows = len(models), np.eye(2, 4), []
    for mean, points in zip(scans.prior_mean, scans.points, strict=True):
        state = multiple_model.State(
            np.stack([mean] * n), np.stack([world.prior_cov] * n), multiple_model.log(world.start)
        )
        for z in points[:, 0]:
            state, fused, _ = multiple_model.imm_step(state, z, models, H, world.noise_cov, world.transition)
            rows.append(fused)
    return np.reshape(rows, (*scans.mask.shape[:2], 4))


def imm_batched(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.batched.multiple_model`."""
    world = point_world(experiment)
    G = np.kron([[0.5 * world.dt**2], [world.dt]], np.eye(2))
    noise = batched.kinematics.piecewise_acceleration(world.variances[:, None], world.dt)
    models = batched.multiple_model.Models(G @ world.accelerations.T, noise, world.transition)
    return batched.multiple_model.track(
        scans.points, scans.mask, scans.prior_mean, world.prior_cov, world.start, world.dt, models, world.noise_cov
    )


def generators_of(scans: Scans) -> list[np.random.Generator]:
    """One generator per run, by its place."""
    return [np.random.default_rng([PARTICLE_SEED, run]) for run in range(len(scans.points))]


def particle_per_run(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.particle_cloud`."""
    world, settings = range_bearing_world(experiment), experiment.filters["particle"]
    each = zip(scans.points[:, :, 0], generators_of(scans), strict=True)
    return np.array(
        [particle_cloud.track(z, rng, world, settings.particles, settings.resample_below) for z, rng in each]
    )


def particle_batched(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.batched.particle`, with the same random numbers."""
    world, settings, generators = range_bearing_world(experiment), experiment.filters["particle"], generators_of(scans)
    starts = range(0, len(generators), PARTICLE_RUNS)
    blocks = [slice(start, start + PARTICLE_RUNS) for start in starts]
    parts = [
        batched.particle.track(
            scans.points[block], scans.mask[block], generators[block], world, settings.particles,
            settings.resample_below,
        )
        for block in blocks
    ]  # fmt: skip
    return np.concatenate(parts)


def shapes_per_run(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.shape_mixture`.

    Raises:
        ValueError: steps are not of one second, or the noise differs between the entries of the state.
    """
    world = connected_world(experiment)
    if world.dt != 1.0 or np.ptp(world.q) != 0.0:
        raise ValueError("the textbook's steps are of one second, with the same noise for all entries")

    def track(points: list[Array]) -> list[Array]:
        return shape_mixture.random_switch(
            [y for (y,) in points], world.mean, world.cov, world.sigma2, world.q[0], world.samples
        )

    return run_by_run(track, scans)


def shapes_batched(experiment: Experiment, scans: Scans) -> Array:
    """`tests.reference.batched.shape_mixture`."""
    return batched.shape_mixture.track(scans.points, scans.mask, *connected_world(experiment))


REFERENCES: dict[str, Reference] = {
    "vb": Reference(vb_per_run, vb_batched, True),
    "mem_ekf_star": Reference(mem_per_run, mem_batched, True),
    "moment_ukf": Reference(moments_per_run, moments_batched, True),
    "multiple_model": Reference(imm_per_run, imm_batched, True),
    "particle": Reference(particle_per_run, particle_batched, False),
    "shape_mixture": Reference(shapes_per_run, shapes_batched, True),
}
"""By name of the workload."""

"""Workloads of the benchmark in plain NumPy say what the filters do, in both forms."""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emt.config.experiment import Experiment
from emt.config.load import load_experiment
from emt.montecarlo.chunks import Engine
from emt.montecarlo.program import Program
from tests.reference import particle
from tests.reference.particle_cloud import log_likelihood, track
from tests.reference.settings import range_bearing_world
from tests.reference.workloads import REFERENCES, Scans, generators_of

SEED = 5
RUNS = dict.fromkeys(REFERENCES, 3) | {"particle": 48}
SHORT = {
    "vb": ("scenario.steps=12",),
    "mem_ekf_star": ("scenario.steps=12",),
    "moment_ukf": ("scenario.steps=12",),
    "multiple_model": (),
    "particle": (
        "scenario.steps=10",
        "filters.particle.particles=2000",
        *(f"{part}.measurement.range_std=5" for part in ("scenario", "model")),
    ),
    "shape_mixture": ("scenario.steps=25",),
}
"""Settings that make a workload small; the legs of `multiple_model` fix its steps."""


class Small(NamedTuple):
    """A workload with few runs, its scans, and what the filter reports (run, step, k)."""

    experiment: Experiment
    scans: Scans
    reports: np.ndarray


@cache
def small(name: str) -> Small:
    """Computed by the engine."""
    experiment = load_experiment(f"benchmark/{name}", SHORT[name]).experiment
    program = Program.of(experiment)
    engine = Engine(program, SEED, RUNS[name], quick=True)
    engine.compile()
    arrays = engine.run_chunk(0, RUNS[name], tracked=RUNS[name])
    (label,) = experiment.filters
    assert not arrays[f"{label}/status"].any()
    own = jax.vmap(lambda run: program.prior_of_run(program.world.prior, jnp.asarray(SEED), run).mean)
    track = {key: arrays.get(f"{label}/track/{key}") for key in ("mean", "semi_axes", "orientation")}
    columns = [track["mean"]]
    if track["orientation"] is not None:
        columns += [track["semi_axes"], track["orientation"][..., None]]
    scans = Scans(arrays["scans/points"], arrays["scans/mask"], np.asarray(own(jnp.arange(RUNS[name]))))
    return Small(experiment, scans, np.concatenate(columns, axis=2))


def assert_close(ours: np.ndarray, theirs: np.ndarray, tolerance: float) -> None:
    """Largest difference of each column, relative to its largest magnitude."""
    assert ours.shape == theirs.shape
    error = np.abs(ours - theirs).max(axis=(0, 1)) / np.abs(theirs).max(axis=(0, 1))
    assert error.max() <= tolerance, error


@pytest.mark.parametrize("name", [name for name, reference in REFERENCES.items() if reference.exact])
def test_both_forms_say_what_the_filter_does(name):
    experiment, scans, reports = small(name)
    assert_close(REFERENCES[name].per_run(experiment, scans), reports, 1e-9)
    assert_close(REFERENCES[name].batched(experiment, scans), reports, 1e-9)


@pytest.mark.parametrize("name", REFERENCES)
def test_both_forms_agree(name):
    experiment, scans, _ = small(name)
    per_run, batched = (form(experiment, scans) for form in REFERENCES[name][:2])
    assert_close(batched, per_run, 1e-9)


def test_particles_say_what_the_filter_does_on_average():
    """Each on the same scans: the mean difference over runs, in standard errors."""
    experiment, scans, reports = small("particle")
    gaps = REFERENCES["particle"].batched(experiment, scans) - reports
    errors = gaps.std(axis=0) / np.sqrt(len(gaps))
    assert errors.max() < 0.5  # m and m/s: a wide interval would show nothing
    assert np.abs(gaps.mean(axis=0) / errors).max() < 4.0


def test_particles_are_those_of_the_textbook():
    """With the same random numbers as the filter that takes one particle after the other."""
    experiment, scans, _ = small("particle")
    world, count, values = range_bearing_world(experiment), 60, scans.points[0, :6, 0]
    means = track(values, generators_of(scans)[0], world, count, 0.5)
    rng, root = generators_of(scans)[0], np.linalg.cholesky(world.Q)
    x = world.mean + rng.standard_normal((4, count)).T @ np.linalg.cholesky(world.cov).T
    log_weights, resampled = np.full(count, -np.log(count)), 0
    for z, mean in zip(values, means, strict=True):
        u, noise = rng.random(), rng.standard_normal((4, count)).T
        step = particle.bootstrap_step(
            x, log_weights, z, u, noise, lambda x, v: world.F @ x + root @ v,
            lambda z, x: log_likelihood(x[:, None], z, world)[0],
        )  # fmt: skip
        x, log_weights = step.particles, step.log_weights
        resampled += not np.array_equal(step.ancestors, np.arange(count))
        np.testing.assert_allclose(mean, step.mean, rtol=1e-9, atol=1e-12)
    assert resampled


def thinned(scans: Scans) -> Scans:
    """Scans of three points at most, some without any, and numbers in empty slots that must not matter."""
    rng = np.random.default_rng(0)
    left = rng.integers(0, 4, scans.mask.shape[:2])
    mask = scans.mask & (np.arange(scans.mask.shape[2]) < left[..., None])
    return scans._replace(points=np.where(mask[..., None], scans.points, 1e3), mask=mask)


@pytest.mark.parametrize("name", [name for name in REFERENCES if name in ("vb", "mem_ekf_star", "moment_ukf")])
def test_both_forms_agree_on_thin_scans(name):
    experiment, scans, _ = small(name)
    per_run, batched = (form(experiment, thinned(scans)) for form in REFERENCES[name][:2])
    assert_close(batched, per_run, 1e-9)

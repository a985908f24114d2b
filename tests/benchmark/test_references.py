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
from tests.reference.workloads import REFERENCES, Scans

RUNS, SEED = 3, 5
SHORT = {
    "vb": ("scenario.steps=12",),
    "mem_ekf_star": ("scenario.steps=12",),
    "multiple_model": (),
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
    engine = Engine(program, SEED, RUNS, quick=True)
    engine.compile()
    arrays = engine.run_chunk(0, RUNS, tracked=RUNS)
    (label,) = experiment.filters
    assert not arrays[f"{label}/status"].any()
    own = jax.vmap(lambda run: program.prior_of_run(program.world.prior, jnp.asarray(SEED), run).mean)
    track = {key: arrays.get(f"{label}/track/{key}") for key in ("mean", "semi_axes", "orientation")}
    columns = [track["mean"]]
    if track["orientation"] is not None:
        columns += [track["semi_axes"], track["orientation"][..., None]]
    scans = Scans(arrays["scans/points"], arrays["scans/mask"], np.asarray(own(jnp.arange(RUNS))))
    return Small(experiment, scans, np.concatenate(columns, axis=2))


def assert_close(ours: np.ndarray, theirs: np.ndarray, tolerance: float) -> None:
    """Largest difference of each column, relative to its largest magnitude."""
    assert ours.shape == theirs.shape
    error = np.abs(ours - theirs).max(axis=(0, 1)) / np.abs(theirs).max(axis=(0, 1))
    assert error.max() <= tolerance, error


@pytest.mark.parametrize("name", REFERENCES)
def test_both_forms_say_what_the_filter_does(name):
    if not REFERENCES[name].exact:
        pytest.skip("its random numbers are others")
    experiment, scans, reports = small(name)
    assert_close(REFERENCES[name].per_run(experiment, scans), reports, 1e-9)
    assert_close(REFERENCES[name].batched(experiment, scans), reports, 1e-9)


@pytest.mark.parametrize("name", REFERENCES)
def test_both_forms_agree(name):
    experiment, scans, _ = small(name)
    per_run, batched = (form(experiment, scans) for form in REFERENCES[name][:2])
    assert_close(batched, per_run, 1e-9)


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

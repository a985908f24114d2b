"""The plain forms of the benchmark's filters say what the textbook says."""

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from emt.benchmark.peers.agreement import largest_difference
from emt.benchmark.peers.base import Scans
from emt.benchmark.peers.given import scans_of
from emt.benchmark.plain import FORMS
from emt.config.experiment import Experiment
from emt.config.load import load_experiment
from emt.montecarlo.compiling import QUICK_COMPILATION
from emt.montecarlo.program import Program
from tests.reference import moment_square_root
from tests.reference.workloads import REFERENCES
from tests.reference.workloads import Scans as TextbookScans

SEED = 5
RUNS = dict.fromkeys(FORMS, 4) | {"particle": 48}
SHORT = dict.fromkeys(FORMS, ("scenario.steps=12",)) | {
    "multiple_model": (),
    "particle": ("scenario.steps=12", *(f"{part}.measurement.range_std=5" for part in ("scenario", "model"))),
}
"""Settings that make a workload small; the legs of `multiple_model` fix its steps. Ranges are less precise than in the
benchmark, which leaves so few particles their weight that a mean over runs says little."""
EXACT = [name for name in FORMS if REFERENCES[name].exact]
EXTENDED = ["vb", "mem_ekf_star", "moment_ukf"]
"""Workloads with several points in a scan."""
potter = moment_square_root.update


class Small(NamedTuple):
    """A workload with few runs, and their scans."""

    experiment: Experiment
    scans: Scans


@cache
def small(name: str) -> Small:
    """Simulated."""
    experiment = load_experiment(f"benchmark/{name}", SHORT[name]).experiment
    program = Program.of(experiment)
    arguments = program.world, jnp.asarray(SEED), jnp.arange(RUNS[name])
    found = program.simulator().lower(*arguments).compile(QUICK_COMPILATION)(*arguments).scans
    arrays = {
        "scans/points": np.swapaxes(np.asarray(found.points), 0, 1),
        "scans/mask": np.swapaxes(np.asarray(found.mask), 0, 1),
    }
    return Small(experiment, scans_of(program, arrays, SEED))


def reports(name: str, experiment: Experiment, scans: Scans) -> np.ndarray:
    """Of the plain form (run, step, k)."""
    function, arguments = FORMS[name](experiment, scans)
    return np.asarray(function.lower(*arguments).compile(QUICK_COMPILATION)(*arguments))


def factored_anew(mean, root, points, rules):
    """The update of `moment_square_root`, but with sigma points from the Cholesky factor at every point."""
    average = potter(mean, root, points, rules)[2]
    for z in points:
        mean, root, _ = potter(mean, root, z[None], rules)
        root = np.linalg.cholesky(root @ root.T)
    return mean, root, average


@pytest.fixture
def textbook(monkeypatch):
    """Reports (run, step, k) of a workload, an experiment and its scans."""
    monkeypatch.setattr(moment_square_root, "update", factored_anew)

    def call(name: str, experiment: Experiment, scans: Scans) -> np.ndarray:
        forms, given = REFERENCES[name], TextbookScans(*scans)
        # the other form has no Cholesky factor at every point
        return (forms.per_run if name == "moment_ukf" else forms.batched)(experiment, given)

    return call


def thinned(scans: Scans) -> Scans:
    """Scans of three points at most, some without any, and numbers in empty slots that must not matter."""
    left = np.random.default_rng(0).integers(0, 4, scans.mask.shape[:2])
    mask = scans.mask & (np.arange(scans.mask.shape[2]) < left[..., None])
    return scans._replace(points=np.where(mask[..., None], scans.points, 1e3), mask=mask)


def test_every_workload_has_one():
    assert list(FORMS) == list(REFERENCES)


@pytest.mark.parametrize("name", EXACT)
def test_the_textbooks_numbers(name, textbook):
    given = small(name)
    assert largest_difference(reports(name, *given), textbook(name, *given)) < 1e-10


@pytest.mark.parametrize("name", EXTENDED)
def test_the_textbooks_numbers_from_few_points(name, textbook):
    experiment, scans = small(name)
    few = thinned(scans)
    assert {0, 1, 2, 3} == set(few.mask.sum(axis=-1).ravel())
    assert largest_difference(reports(name, experiment, few), textbook(name, experiment, few)) < 1e-10


def test_the_textbooks_statistics(textbook):
    """Of particles on the same scans: the mean difference over runs, in standard errors."""
    given = small("particle")
    gaps = reports("particle", *given) - textbook("particle", *given)
    errors = gaps.std(axis=0) / np.sqrt(len(gaps))
    assert errors.max() < 0.3  # m and m/s: a wide interval would show nothing
    assert np.abs(gaps.mean(axis=0) / errors).max() < 4.0


@pytest.mark.parametrize("name", ["multiple_model", "particle"])
def test_a_missed_measurement_is_refused(name):
    experiment, scans = small(name)
    with pytest.raises(ValueError, match="in every scan"):
        FORMS[name](experiment, scans._replace(mask=np.zeros_like(scans.mask)))


@pytest.mark.parametrize("name", FORMS)
def test_an_update_before_the_first_prediction_is_refused(name):
    experiment, scans = small(name)
    with pytest.raises(ValueError, match="predict before the first scan"):
        FORMS[name](experiment.model_copy(update={"start_with": "update"}), scans)

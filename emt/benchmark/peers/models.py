"""The numbers of an experiment as the NumPy arrays that other packages take."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from emt.benchmark.peers.base import Scans
from emt.config.experiment import Experiment
from emt.config.state_space_model import StateSpaceModelSettings
from emt.models.state_space.motions import Motion
from emt.models.state_space.settings import PositionSettings


class Transition(NamedTuple):
    """x ← F x + b + v over one step."""

    matrix: np.ndarray
    """F (n, n)."""
    offset: np.ndarray
    """b (n,)."""
    noise_cov: np.ndarray
    """Covariance of v (n, n)."""

    @staticmethod
    def of(motion: Motion, dt: float) -> "Transition":
        """Of a linear motion, for steps of `dt` seconds."""
        length, noise_cov = jnp.asarray(dt), np.asarray(motion.noise_cov(jnp.asarray(dt)))
        offset, matrix = motion.linearised(jnp.zeros(len(noise_cov)), length, length)
        return Transition(np.asarray(matrix), np.asarray(offset), noise_cov)


def settings_of(experiment: Experiment, kind: str) -> Any:
    """Settings of the first filter of that kind.

    Raises:
        ValueError: there is none.
    """
    found = next((settings for settings in experiment.filters.values() if settings.kind == kind), None)
    if found is None:
        raise ValueError(f"the experiment has no filter of kind '{kind}'")
    return found


def prior_means(experiment: Experiment, scans: Scans) -> np.ndarray:
    """Mean of the prior of each run (run, n).

    Raises:
        ValueError: it is drawn anew for each run, and the draws are not given.
    """
    prior = experiment.model.prior
    if scans.prior_means is not None:
        return np.asarray(scans.prior_means)
    if prior.drawn:
        raise ValueError("the experiment draws the prior mean of each run: give Scans.prior_means")
    return np.tile(np.asarray(prior.mean), (len(scans.points), 1))


def single_measurements(scans: Scans) -> list[list[np.ndarray | None]]:
    """The measurement of each scan of a point, by run and step; None where it was missed."""
    return [[points[0] if len(points) else None for points in run] for run in scans.real()]


def point_model(experiment: Experiment) -> StateSpaceModelSettings:
    """Model of an experiment on a point.

    Raises:
        ValueError: it is on something else.
    """
    if not isinstance(experiment.model, StateSpaceModelSettings):
        raise ValueError("the experiment is not on a point")
    return experiment.model


class Bank(NamedTuple):
    """Interacting multiple models of a point whose position is measured."""

    motions: list[Transition]
    chain: np.ndarray
    """Probabilities of going from a motion (row) to each."""
    start: np.ndarray
    """Probabilities of the motions before the first prediction."""
    prior_cov: np.ndarray
    observed: np.ndarray
    """Measurement matrix (m, n)."""
    noise_cov: np.ndarray
    """Covariance of a measurement."""

    @staticmethod
    def of(experiment: Experiment) -> "Bank":
        """Of an experiment with a filter `multiple_model`.

        Raises:
            ValueError: the filter or the measurement is not one that can be compared.
        """
        settings, model = settings_of(experiment, "multiple_model"), point_model(experiment)
        if settings.method != "imm" or settings.motions:
            raise ValueError("only method: imm over all motions of the model can be compared")
        if not isinstance(model.measurement, PositionSettings):
            raise ValueError("only a measurement of the position can be compared")
        noise_cov, n = np.array(model.measurement.noise_cov), len(model.states)
        return Bank(
            [Transition.of(motion.build(), experiment.scenario.dt) for motion in model.named_motions.values()],
            np.array(model.transition_matrix),
            np.array(model.start_probabilities),
            np.array(model.prior.cov),
            np.eye(len(noise_cov), n),
            noise_cov,
        )

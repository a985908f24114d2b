"""An experiment as compiled functions of (seed, run numbers): the simulator and one program per filter."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emt.config.experiment import Divergence, Experiment, ModelSettings, PriorSettings
from emt.filters.base import TrackingModel, guarded
from emt.keys import Purpose, filter_key, purpose_key, run_key
from emt.linalg import Sym2, cholesky
from emt.metrics.base import Metric, find_metric
from emt.models.motion import FixedNoise, WhiteAcceleration
from emt.montecarlo.run import Limits, Rules, Scores, Tracker, score
from emt.registry import FILTERS, SCENARIOS
from emt.shapes.moments import ellipse_of
from emt.types import Ellipse, Measurements, Prior, Scenario, Truth


class Simulation(NamedTuple):
    """Truth and scans of a chunk of runs; leading axes run, time."""

    truth: Truth
    scans: Measurements


class WorldParams(NamedTuple):
    """Traced numbers that all filters share."""

    scenario: Any
    model: TrackingModel
    prior: Prior
    limits: Limits


def cast(tree, dtype):
    """Every floating-point leaf in the given precision; other leaves as they are."""

    def leaf(x):
        array = np.asarray(x)
        return jnp.asarray(array, dtype if array.dtype.kind == "f" else array.dtype)

    return jax.tree.map(leaf, tree)


def prior_of(settings: PriorSettings) -> Prior:
    """The prior of a checked experiment."""
    if settings.moments is None:
        ellipse = Ellipse(jnp.asarray(settings.semi_axes), jnp.asarray(settings.orientation))
    else:
        n11, n20, n02 = settings.moments
        ellipse = ellipse_of(Sym2(*(jnp.asarray(n) for n in (n20, n11, n02))))
    mean, cov = jnp.asarray(settings.mean), jnp.asarray(settings.cov)
    return Prior(mean, cov, ellipse, settings.turn_rate, settings.turn_rate_variance)


def model_of(settings: ModelSettings) -> TrackingModel:
    """The world model of a checked experiment."""
    noise = settings.process_noise
    return TrackingModel(
        WhiteAcceleration(noise.psd) if noise.kind == "white_acceleration" else FixedNoise.of(noise.cov),
        Sym2.of(np.array(settings.noise_cov)),
        settings.extent_scale,
    )


def limits_of(rule: Divergence | None) -> Limits:
    """The divergence rule of a checked experiment; by default no run diverges."""
    if rule is None:
        return Limits(np.inf, None)
    return Limits(np.inf if rule.position_error_above is None else rule.position_error_above, rule.final_iou_below)


@dataclass(frozen=True)
class Program:
    """What an experiment computes. The functions take chunks of run numbers; the numbers of a run depend on the seed
    and the run number only."""

    experiment: Experiment
    world: WorldParams
    filter_params: dict[str, Any]
    make_scenario: Callable[[Any], Scenario]
    make_filter: dict[str, Callable]
    metrics: tuple[Metric, ...]
    n_steps: int

    @staticmethod
    def of(experiment: Experiment) -> "Program":
        """Builds scenario and filters of a checked experiment.

        Raises:
            DataError: a recording cannot be used.
        """
        dtype = jnp.dtype(experiment.monte_carlo.dtype)
        scenario_params, make_scenario = SCENARIOS.get(experiment.scenario.kind).builder(
            experiment.scenario, experiment.monte_carlo.runs
        )
        model = experiment.model
        world = WorldParams(scenario_params, model_of(model), prior_of(model.prior), limits_of(experiment.divergence))
        built = {label: FILTERS.get(settings.kind).builder(settings) for label, settings in experiment.filters.items()}
        world = cast(world, dtype)
        n_steps = jax.eval_shape(lambda p: make_scenario(p).dt, world.scenario).shape[0]
        return Program(
            experiment,
            world,
            {label: cast(params, dtype) for label, (params, _) in built.items()},
            make_scenario,
            {label: make for label, (_, make) in built.items()},
            tuple(find_metric(name) for name in experiment.metrics),
            n_steps,
        )

    def simulate_run(self, world: WorldParams, seed, run) -> Simulation:
        """Truth and scans of one run."""
        scenario, key = self.make_scenario(world.scenario), run_key(seed, run)
        truth = scenario.sample_truth(purpose_key(key, Purpose.TRUTH))
        return Simulation(truth, scenario.sample_scans(truth, purpose_key(key, Purpose.MEASUREMENTS)))

    def score_run(self, label: str, world, params, seed, run, scans: Measurements, target: Truth) -> Scores:
        """Scores of one filter in one run."""
        flt = guarded(self.make_filter[label](params, world.model))
        tracker = Tracker(flt, self.prior_of_run(world.prior, seed, run), self.experiment.start_with == "predict")
        key = filter_key(run_key(seed, run), label)
        dt = self.make_scenario(world.scenario).dt
        return score(tracker, self.rules_for(label), target, scans, dt, key, world.limits)

    def prior_of_run(self, prior: Prior, seed, run) -> Prior:
        """What the filters are told in one run: the prior itself, or one with a mean drawn from it."""
        if not self.experiment.model.prior.drawn:
            return prior
        draw = jax.random.normal(purpose_key(run_key(seed, run), Purpose.PRIOR), (5,), prior.mean.dtype)
        return prior._replace(
            mean=prior.mean + cholesky(prior.cov) @ draw[:4],
            turn_rate=prior.turn_rate + jnp.sqrt(prior.turn_rate_var) * draw[4],
        )

    def rules_for(self, label: str) -> Rules:
        """A reference filter is not compared with itself; it has no metrics."""
        metrics = () if label == self.experiment.reference else self.metrics
        return Rules(metrics, self.experiment.skip_steps, self.experiment.traces)

    def without(self, metric: Metric) -> list[str]:
        """Labels of the filters that do not have the metric, or are what the others are compared with."""

        def estimate(label: str):
            flt = self.make_filter[label](self.filter_params[label], self.world.model)
            return flt.estimate(flt.init(self.world.prior, jax.random.key(0)))

        return [
            label
            for label in self.filter_params
            if label == self.experiment.reference or not metric.applies_to(jax.eval_shape(partial(estimate, label)))
        ]

    def simulator(self) -> Callable[..., Simulation]:
        """Jitted (world, seed, runs) -> Simulation, mapped over runs."""
        return jax.jit(jax.vmap(self.simulate_run, in_axes=(None, None, 0)))

    def scorer(self, label: str) -> Callable[..., Scores]:
        """Jitted (world, params, seed, runs, scans, target) -> Scores of one filter, mapped over runs."""
        return jax.jit(jax.vmap(partial(self.score_run, label), in_axes=(None, None, None, 0, 0, 0)))

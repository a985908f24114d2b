"""An experiment as compiled functions of (seed, run numbers): the simulator and one program per filter."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emt.config.experiment import Experiment
from emt.filters.base import guarded
from emt.keys import Purpose, filter_key, filter_number, purpose_key, run_key
from emt.metrics.base import Metric, has
from emt.montecarlo.devices import over_runs
from emt.montecarlo.run import Limits, Rules, Scores, Tracker, score
from emt.montecarlo.world import drawn_prior, limits_of, model_of, prior_of
from emt.registry import FILTERS, SCENARIOS
from emt.settings import reads_points
from emt.types import Articulated, Estimate, Info, Measurements, Point, Prior, Scenario, StatePrior, Truth


class Simulation(NamedTuple):
    """Truth and scans of a chunk of runs; leading axes time, run: filters go through it step by step, and each step of
    all runs lies together in memory."""

    truth: Truth
    scans: Measurements


RUNS_OF_SIMULATION = 1
"""Their axis."""
SCORED = (None, None, None, 0, RUNS_OF_SIMULATION, RUNS_OF_SIMULATION)
"""Axes of runs of world, parameters, seed, runs, scans and target: what a filter is mapped over."""


class WorldParams(NamedTuple):
    """Traced numbers that all filters share."""

    scenario: Any
    model: Any
    """A `TrackingModel`, a `ConnectedModel` or a `StateSpaceModel`."""
    prior: Prior | StatePrior
    limits: Limits


def cast(tree, dtype):
    """Every floating-point leaf in the given precision; other leaves as they are."""

    def leaf(x):
        array = np.asarray(x)
        return jnp.asarray(array, dtype if array.dtype.kind == "f" else array.dtype)

    return jax.tree.map(leaf, tree)


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
    _told: dict[str, tuple[Estimate, Info]] = field(default_factory=dict, init=False, repr=False, compare=False)
    """Of each filter, found once: tracing a filter takes a while."""

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
        world = WorldParams(scenario_params, model_of(model), prior_of(model), limits_of(experiment.divergence))
        built = {label: FILTERS.get(settings.kind).builder(settings) for label, settings in experiment.filters.items()}
        world = cast(world, dtype)
        n_steps = jax.eval_shape(lambda p: make_scenario(p).dt, world.scenario).shape[0]
        return Program(
            experiment,
            world,
            {label: cast(params, dtype) for label, (params, _) in built.items()},
            make_scenario,
            {label: make for label, (_, make) in built.items()},
            tuple(experiment.metric(name) for name in experiment.metrics),
            n_steps,
        )

    def simulate_run(self, world: WorldParams, seed, run, points: bool = True) -> Simulation:
        """Truth and scans of one run.

        Args:
            points: whether scans hold their points; else only statistics, where the scenario gives them.
        """
        scenario, key = self.make_scenario(world.scenario), run_key(seed, run)
        truth = scenario.sample_truth(purpose_key(key, Purpose.TRUTH))
        scans = scenario.sample_scans(truth, purpose_key(key, Purpose.MEASUREMENTS))
        if not points and scans.statistics is not None:
            scans = scans._replace(points=scans.points[:, :0], mask=scans.mask[:, :0])
        return Simulation(truth, scans)

    @property
    def needs_points(self) -> bool:
        """Whether anything reads the points of scans; if not, simulated scans hold statistics only, which take a tenth
        of the memory."""
        return self.experiment.traces or any(reads_points(filt) for filt in self.experiment.filters.values())

    def score_run(
        self, label: str, world, params, seed, run, scans: Measurements, target: Truth, number=None
    ) -> Scores:
        """Scores of one filter in one run; its random numbers are those of the label, or of another `number`."""
        flt = guarded(self.make_filter[label](params, world.model))
        tracker = Tracker(flt, self.prior_of_run(world.prior, seed, run), self.experiment.start_with == "predict")
        key = filter_key(run_key(seed, run), filter_number(label) if number is None else number)
        dt = self.make_scenario(world.scenario).dt
        return score(tracker, self.rules_for(label), target, scans, dt, key, world.limits)

    def prior_of_run(self, prior: Prior | StatePrior, seed, run) -> Prior | StatePrior:
        """What the filters are told in one run: the prior itself, or one with a mean drawn from it."""
        if not self.experiment.model.prior.drawn:
            return prior
        return drawn_prior(prior, purpose_key(run_key(seed, run), Purpose.PRIOR))

    def rules_for(self, label: str) -> Rules:
        """A reference filter is not compared with itself; it has no metrics."""
        metrics = () if label == self.experiment.reference else self.metrics
        rule = self.experiment.divergence
        last, exclude = (rule.last_steps, rule.exclude) if rule is not None else (1, True)
        return Rules(metrics, self.experiment.skip_steps, self.experiment.traces, last, exclude)

    def without(self, metric: Metric) -> list[str]:
        """Labels of the filters that do not have the metric, or are what the others are compared with."""
        return [
            label
            for label in self.filter_params
            if label == self.experiment.reference or not has(metric, *self.told_by(label))
        ]

    def told_by(self, label: str) -> tuple[Estimate, Info]:
        """Shapes and names of a filter's reports, and what it tells of its updates."""
        if label not in self._told:
            self._told[label] = jax.eval_shape(lambda: self._first(label))
        return self._told[label]

    def _first(self, label: str) -> tuple[Estimate, Info]:
        """The first report and update of a filter."""
        flt, key = self.make_filter[label](self.filter_params[label], self.world.model), jax.random.key(0)
        state = flt.init(self.world.prior, key)
        if not any(metric.reads for metric in self.metrics):
            return flt.estimate(state), Info(jnp.zeros(()), jnp.zeros(()), jnp.zeros((), int))  # no update is traced
        scans = self.simulate_run(self.world, jnp.asarray(0), jnp.asarray(0)).scans
        return flt.estimate(state), flt.update(state, jax.tree.map(lambda leaf: leaf[0], scans), key)[1]

    def tells_mode(self) -> bool:
        """Whether the scenario tells the true mode."""
        key = jax.random.key(0)
        return jax.eval_shape(lambda: self.make_scenario(self.world.scenario).sample_truth(key)).mode is not None

    def state_names(self) -> list[str]:
        """Names of the entries of the filters' means."""
        shape = self.told_by(next(iter(self.filter_params)))[0].shape
        if isinstance(shape, Point):
            return list(shape.names)
        return list(shape.plan.state) if isinstance(shape, Articulated) else ["x", "y", "vx", "vy"]

    def unit_of(self, metric: Metric) -> str:
        """Unit of a metric for the filters here."""
        if metric.unit_of is None:
            return metric.unit
        having = [label for label in self.filter_params if label not in self.without(metric)]
        return metric.unit_of(self.told_by(having[0])[0]) if having else metric.unit

    def dof_of(self, metric: Metric) -> int:
        """Degrees of freedom of a metric that is a normalised square."""
        having = [label for label in self.filter_params if label not in self.without(metric)]
        return metric.dof(self.told_by(having[0])[0]) if metric.dof is not None and having else 0

    def simulator(self, devices: Sequence[Any] | None = None, points: bool = True) -> Callable[..., Simulation]:
        """Jitted (world, seed, runs) -> Simulation, mapped over runs; see `simulate_run` for `points`."""
        simulate = partial(self.simulate_run, points=points)
        return over_runs(simulate, (None, None, 0), devices or jax.devices()[:1], RUNS_OF_SIMULATION)

    def scorer(self, label: str) -> Callable[..., Scores]:
        """Jitted (world, params, seed, runs, scans, target) -> Scores of one filter, mapped over runs."""
        return over_runs(partial(self.score_run, label), SCORED, jax.devices()[:1])

    def shared_scorer(self, label: str, devices: Sequence[Any] | None = None) -> Callable[..., Scores]:
        """The same with the number of the filter (see `keys.filter_number`) as a last argument: filters that differ in
        label and parameters only are one program, which the cache keeps once."""
        return over_runs(partial(self.score_run, label), (*SCORED, None), devices or jax.devices()[:1])

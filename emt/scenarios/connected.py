"""A connected object whose angles swing, seen as points of its components."""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float, Int
from pydantic import Field, PositiveInt, model_validator

from emt.keys import step_key
from emt.linalg import Mat2
from emt.models.switching import SwitchingSettings
from emt.registry import SCENARIOS
from emt.scenarios.detections import noise_root
from emt.settings import Angle, Duration, Fraction, Length, NoiseCovariance, PositiveLength, Settings, TurnRate
from emt.shapes.articulated import sources
from emt.shapes.connected import Connected, ConnectedSettings, Name, connected, parameter_faults, probability_faults
from emt.types import Articulated, Measurements, Scenario, Traced, Truth

CLUTTER = -1
"""Source of a point of no component."""


class Swing(Settings):
    """center + amplitude sin(rate t + phase), with t = 0 one step before the first scan."""

    center: Angle
    amplitude: Angle = 0.0
    rate: TurnRate = 0.0
    phase: Angle = 0.0


class UniformClutterSettings(Settings):
    """Points of no component, uniform over a rectangle, in place of points of the object."""

    probability: Fraction
    low: tuple[Length, Length]
    high: tuple[Length, Length]


class ConnectedScenarioSettings(Settings):
    """A connected object with constant lengths and swinging angles."""

    kind: Literal["connected"] = "connected"
    shape: ConnectedSettings
    """The true object; usually an alias of that in the model."""
    steps: PositiveInt
    dt: Duration = 1.0
    lengths: dict[Name, PositiveLength] = Field(default_factory=dict)
    """True lengths, by parameter."""
    angles: dict[Name, Swing] = Field(default_factory=dict)
    """True angles, by parameter."""
    noise_cov: NoiseCovariance
    """Covariance of the Gaussian sensor noise of each point."""
    points: Annotated[PositiveInt, Field(le=1000)] = 1
    """Points per scan."""
    probabilities: dict[Name, Fraction] | None = None
    """Probability that a point comes from each component; by default equal."""
    markov: SwitchingSettings | None = None
    """The component of a scan depends on that of the scan before; all its points come from the same one."""
    clutter: UniformClutterSettings | None = None
    has_truth: ClassVar[bool] = True
    tracks: ClassVar[str] = "connected"

    @model_validator(mode="after")
    def _fit(self):
        faults = parameter_faults(self.shape, self.lengths, self.angles)
        names = tuple(self.shape.components)
        faults += [f"probabilities: {fault}" for fault in probability_faults(self.probabilities, names)]
        if self.markov is not None:
            faults += [f"markov.{fault}" for fault in self.markov.faults(names)]
            if self.probabilities is not None:
                faults.append("probabilities: a Markov chain has its own")
        if faults:
            raise ValueError("; ".join(faults))
        return self

    @property
    def n_steps(self) -> int:
        return self.steps


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the scenario."""

    dt: Traced
    lengths: Float[Array, "n"]
    """True lengths at their places in the state, 0 elsewhere."""
    swings: Float[Array, "n_angles 4"]
    """Centre, amplitude, rate and phase of every angle."""
    noise_root: Mat2
    probabilities: Float[Array, "c"]
    transition: Float[Array, "c c"] | None
    clutter: Float[Array, "5"] | None
    """Probability, low x, low y, high x, high y."""
    plan: Connected = field(metadata={"static": True})


def true_states(params: Params, n_steps: int) -> Float[Array, "n_steps n"]:
    """Parameters and rates of the object at every scan."""
    times = params.dt * jnp.arange(1.0, n_steps + 1.0, dtype=params.lengths.dtype)
    states = jnp.broadcast_to(params.lengths, (n_steps, len(params.lengths)))
    for k, place in enumerate(params.plan.angles):
        center, amplitude, rate, phase = params.swings[k]
        states = states.at[:, place].set(center + amplitude * jnp.sin(rate * times + phase))
        states = states.at[:, place + 1].set(amplitude * rate * jnp.cos(rate * times + phase))
    return states


def drawn(u: Float[Array, ""], probabilities: Float[Array, "c"]) -> Int[Array, ""]:
    """A number drawn with these probabilities, from a number uniform on (0, 1)."""
    below = (u >= jnp.cumsum(probabilities)).sum()
    return jnp.minimum(below, len(probabilities) - 1)


def components_of(u: Float[Array, "n_steps points"], params: Params) -> Int[Array, "n_steps points"]:
    """Component of every point, from numbers uniform on (0, 1)."""
    if params.transition is None:
        return jax.vmap(jax.vmap(lambda x: drawn(x, params.probabilities)))(u)
    rows = params.transition

    def step(component, x):
        new = drawn(x, rows[component])
        return new, new

    first = drawn(u[0, 0], params.probabilities)
    _, chain = jax.lax.scan(step, first, u[1:, 0])
    return jnp.broadcast_to(jnp.concatenate([first[None], chain])[:, None], u.shape)


def build(settings: ConnectedScenarioSettings, runs: int):
    """Traced parameters and static builder of the settings."""
    plan, n_parts, n_steps = connected(settings.shape), len(settings.shape.components), settings.steps
    names, chosen, clutter = plan.components, settings.probabilities, settings.clutter
    angles = [settings.angles[plan.state[place]] for place in plan.angles]
    params = Params(
        settings.dt,
        jnp.array([settings.lengths.get(name, 0.0) for name in plan.state]),
        jnp.array([[a.center, a.amplitude, a.rate, a.phase] for a in angles]).reshape(-1, 4),
        noise_root(settings.noise_cov),
        jnp.array([chosen[name] if chosen else 1.0 / n_parts for name in names]),
        jnp.array(settings.markov.matrix(names)) if settings.markov else None,
        jnp.array([clutter.probability, *clutter.low, *clutter.high]) if clutter else None,
        plan,
    )

    def make(params: Params) -> Scenario:
        def sample_truth(key) -> Truth:
            states = true_states(params, n_steps)
            return Truth(states, Articulated(states, plan))

        def sample_scans(truth: Truth, key) -> Measurements:
            dtype, points = truth.state.dtype, settings.points
            keys = jax.vmap(lambda k: step_key(key, k))(jnp.arange(n_steps))
            u = jax.vmap(lambda k: jax.random.uniform(jax.random.fold_in(k, 0), (points, 5), dtype))(keys)
            noise = jax.vmap(lambda k: jax.random.normal(jax.random.fold_in(k, 1), (points, 2), dtype))(keys)
            source = components_of(u[..., 0], params)
            seen = jax.vmap(jax.vmap(lambda s, v: sources(plan, s, v), in_axes=(None, 0)))(truth.state, u[..., 1:4])
            seen = jnp.take_along_axis(seen, source[..., None, None], axis=2)[:, :, 0]
            root, (v, w) = params.noise_root, (noise[..., 0], noise[..., 1])
            seen = seen + jnp.stack([root.xx * v, root.yx * v + root.yy * w], axis=-1)
            if params.clutter is not None:
                low, high = params.clutter[1:3], params.clutter[3:5]
                place = jnp.stack([low[k] + u[..., 1 + k] * (high[k] - low[k]) for k in range(2)], axis=-1)
                is_clutter = u[..., 4] < params.clutter[0]
                seen = jnp.where(is_clutter[..., None], place, seen)
                source = jnp.where(is_clutter, CLUTTER, source)
            full = jnp.ones((n_steps, points), bool)
            return Measurements(seen, full, jnp.zeros(n_steps, bool), source)

        return Scenario(jnp.full(n_steps, params.dt), sample_truth, sample_scans)

    return params, make


SCENARIOS.register("connected", ConnectedScenarioSettings, build)

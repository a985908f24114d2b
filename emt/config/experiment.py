"""The experiment: everything a configuration file may say."""

from typing import Annotated, Any, Literal, Union

from pydantic import (
    AfterValidator,
    Field,
    NonNegativeInt,
    PositiveInt,
    StringConstraints,
    create_model,
    model_validator,
)

import emt.filters.catalogue
import emt.metrics.catalogue
import emt.scenarios.catalogue  # noqa: F401  (these three fill the registries)
from emt.config.connected_model import ConnectedModelSettings
from emt.config.state_space_model import StateSpaceModelSettings
from emt.metrics.base import Metric, RmseRule, find_metric, under_rule
from emt.models.motion import NoiseSettings
from emt.registry import FILTERS, SCENARIOS, Entry, Registry
from emt.settings import (
    Angle,
    Covariance4,
    Fraction,
    NoiseCovariance,
    PositiveFloat,
    PositiveLength,
    Quantity,
    Settings,
    TurnRate,
    TurnRateVariance,
    Vector4,
)

Label = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,39}$")]


def known_metric(name: str) -> str:
    """The name of a metric, checked."""
    return find_metric(name).name


MomentValue = Annotated[float, Quantity("m^2")]
MetricName = Annotated[str, AfterValidator(known_metric)]


def union_of(registry: Registry[Any], kinds: tuple[str, ...] = ()) -> Any:
    """The union, told apart by `kind`, of all built-in settings and of the plug-ins named in `kinds`."""
    classes = [_with_kind(registry.get(name)) for name in dict.fromkeys((*registry.builtin(), *kinds))]
    return Annotated[Union[tuple(classes)], Field(discriminator="kind")]  # noqa: UP007


def _with_kind(entry: Entry[Any]) -> type:
    """The settings of a kind; those of a plug-in accept the name under which the file asked for it."""
    declared = entry.settings.model_fields.get("kind")
    if declared is not None and declared.annotation == Literal[entry.name]:
        return entry.settings
    kind: Any = (Literal[entry.name], entry.name)
    return create_model(entry.settings.__name__, __base__=entry.settings, kind=kind)


class MonteCarlo(Settings):
    """How many runs, and which."""

    runs: Annotated[PositiveInt, Field(le=1_000_000_000)] = 100
    smoke_runs: PositiveInt = 32
    """Runs at the reduced scale of `emt check` and `emt reproduce --scale smoke`."""
    smoke_settings: dict[str, int] = Field(default_factory=dict)
    """Settings that are different at that scale, by their dotted keys: fewer steps, say."""
    smoke_filters: tuple[Label, ...] = ()
    """Filters that take part at that scale; by default all."""
    seed: Annotated[NonNegativeInt, Field(lt=2**63)] = 0
    chunk: Annotated[PositiveInt, Field(le=1_000_000)] | None = None
    """Runs computed together, part of a result's identity; by default 208, and 1 for recordings. Multiples of 16 that
    are no power of two are fastest."""
    dtype: Literal["float64", "float32"] = "float64"


class PriorSettings(Settings):
    """What every filter believes before the first scan. Its certainty about the shape is a setting of each filter."""

    mean: Vector4
    """Position and velocity: x, y, vx, vy."""
    cov: Covariance4
    orientation: Angle = 0.0
    semi_axes: tuple[PositiveLength, PositiveLength] | None = None
    """The first lies along `orientation`."""
    moments: tuple[MomentValue, MomentValue, MomentValue] | None = None
    """The shape by its normalised centred moments n11, n20, n02 instead of semi-axes and orientation."""
    turn_rate: TurnRate = 0.0
    """Mean of the turn rate, for filters that estimate it."""
    turn_rate_variance: TurnRateVariance = 0.0
    drawn: bool = False
    """Whether each run starts from a mean of its own, drawn from N(mean, cov), the same for all filters."""

    @model_validator(mode="after")
    def _one_shape(self):
        if (self.semi_axes is None) == (self.moments is None):
            raise ValueError("give the shape either by semi_axes or by moments")
        if self.moments is not None:
            n11, n20, n02 = self.moments
            if not (n20 > 0.0 and n20 * n02 > n11 * n11):
                raise ValueError(
                    "moments: n11, n20, n02 are not those of an ellipse: n20, n02 and n20 n02 - n11² must be positive, "
                    f"got {n20:g}, {n02:g} and {n20 * n02 - n11 * n11:g}"
                )
            if self.orientation != 0.0:
                raise ValueError("orientation: the moments already give it")
        return self


class ModelSettings(Settings):
    """The world as every filter is told it is."""

    process_noise: NoiseSettings
    """Process noise of the constant-velocity motion."""
    noise_cov: NoiseCovariance
    """Covariance of the sensor noise of one point."""
    extent_scale: PositiveFloat
    """Covariance of the points on the object in units of the squared semi-axes: 0.25 uniform, 1 Gaussian."""
    prior: PriorSettings


class Divergence(Settings):
    """When a run counts as lost, apart from numerical failure."""

    position_error_above: PositiveLength | None = None
    """At any scan."""
    final_iou_below: Fraction | None = None
    """Intersection over union at the last scan."""
    final_mean_above: dict[MetricName, PositiveFloat] = Field(default_factory=dict)
    """Means over the last steps of metrics of the experiment, in SI units."""
    last_steps: PositiveInt = 1
    """Steps at the end for these means."""
    exclude: bool = True
    """Whether lost runs leave the averages; if not, they are counted only (metric `lost`)."""

    @model_validator(mode="after")
    def _not_empty(self):
        if self.position_error_above is None and self.final_iou_below is None and not self.final_mean_above:
            raise ValueError("give position_error_above, final_iou_below or final_mean_above")
        return self


class Sources(Settings):
    """Where values come from: dotted keys of this file, each standing for everything below it."""

    paper: tuple[str, ...] = ()
    """Printed in the paper."""
    published_code: tuple[str, ...] = ()
    """Taken from public code of the paper's authors or of the method's authors."""
    calibrated: tuple[str, ...] = ()
    """Not printed anywhere: chosen so that the published results are met."""


class Experiment(Settings):
    """One scenario, the filters that are compared on it, and the metrics."""

    name: str | None = None
    """Name in results; by default that of the file, within its paper's folder."""
    paper: str | None = None
    """Key of the paper whose numbers stand in experiments/PAPER/published.yaml."""
    title: str = ""
    length_unit: Literal["m", "cm", "px"] = "m"
    """Unit of every bare length, for headings; lengths with a unit of their own are metres."""
    monte_carlo: MonteCarlo = MonteCarlo()
    scenario: union_of(SCENARIOS)  # type: ignore[valid-type]
    model: ModelSettings
    start_with: Literal["update", "predict"] = "update"
    """Whether the first scan is preceded by a prediction."""
    filters: Annotated[dict[Label, union_of(FILTERS)], Field(min_length=1)]  # type: ignore[valid-type]
    reference: str = "truth"
    """What estimates are compared with: the truth, or the filter with this label."""
    rmse: RmseRule = "per_step"
    """How root-mean-square errors (`position_rmse`, `velocity_rmse`) average over steps: "per_step", root over runs at
    each step, then the mean over steps; or "pooled", one root of the mean over runs and steps."""
    metrics: tuple[MetricName, ...] = ("gw", "iou", "position_rmse", "velocity_rmse", "nees")
    segments: dict[Label, tuple[PositiveInt, PositiveInt]] = Field(default_factory=dict)
    """First and last scan (from 1) of stretches of time on which root-mean-square errors are shown apart."""
    skip_steps: NonNegativeInt = 0
    """Steps at the start that do not count in the averages over time."""
    divergence: Divergence | None = None
    traces: bool = False
    """Whether every estimate of every run is stored."""
    sources: Sources = Sources()

    def metric(self, name: str) -> Metric:
        """The metric of that name, under the experiment's rules.

        Raises:
            UnknownName: there is none.
        """
        return under_rule(find_metric(name), self.rmse)

    @property
    def chunk_size(self) -> int:
        """Runs computed together."""
        return self.monte_carlo.chunk or (208 if self.scenario.has_truth else 1)


class ConnectedExperiment(Experiment):
    """An experiment on a connected object."""

    model: ConnectedModelSettings  # type: ignore[assignment]


class StateSpaceExperiment(Experiment):
    """An experiment on a point."""

    model: StateSpaceModelSettings  # type: ignore[assignment]


EXPERIMENTS: dict[Any, type[Experiment]] = {"connected": ConnectedExperiment, "state_space": StateSpaceExperiment}
"""Experiments by the kind of their model, which is that of an ellipse if none is given."""


def model_for(data: Any) -> type[Experiment]:
    """The settings class for a file's content: `Experiment`, widened by the plug-ins the file names.

    Raises:
        PluginError: a named plug-in cannot be used.
    """
    if not isinstance(data, dict):
        return Experiment
    filters, scenario, model = data.get("filters"), data.get("scenario"), data.get("model")
    kind = model.get("kind") if isinstance(model, dict) else None
    named = [f.get("kind") for f in filters.values() if isinstance(f, dict)] if isinstance(filters, dict) else []
    plugin_filters = _plugins(FILTERS, named)
    plugin_scenarios = _plugins(SCENARIOS, [scenario.get("kind")] if isinstance(scenario, dict) else [])
    base = EXPERIMENTS.get(kind, Experiment) if isinstance(kind, str) else Experiment
    if not plugin_filters and not plugin_scenarios:
        return base
    widened: Any = {
        "filters": (Annotated[dict[Label, union_of(FILTERS, plugin_filters)], Field(min_length=1)], ...),
        "scenario": (union_of(SCENARIOS, plugin_scenarios), ...),
    }
    return create_model("Experiment", __base__=base, **widened)


def _plugins(registry: Registry[Any], named: list[Any]) -> tuple[str, ...]:
    candidates = {name for name in named if isinstance(name, str)} - set(registry.builtin())
    return tuple(sorted(name for name in candidates if ":" in name or name in registry.names()))

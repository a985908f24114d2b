"""From a file or a shipped name to a checked experiment."""

import copy
import sys
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from emt.config.errors import ConfigError, Problem, dotted, validate
from emt.config.experiment import Experiment, model_for
from emt.config.overrides import apply_overrides
from emt.config.shipped import SHIPPED, config_names, config_path
from emt.config.source import Source, load_source
from emt.config.warning import ConfigWarning
from emt.registry import PluginError, UnknownName, suggest

NOT_RESULTS = ("name", "paper", "title", "length_unit", "sources")
"""Settings that name or explain; a result does not depend on them."""


class Loaded(NamedTuple):
    """An experiment and where it came from."""

    name: str
    """`PAPER/EXPERIMENT` for shipped experiments, otherwise the name the file gives itself, or its stem."""
    experiment: Experiment
    source: Source

    def identity(self) -> dict[str, Any]:
        """Everything the results depend on, as plain data; the number of runs is not part of it."""
        config = self.experiment.model_dump(mode="json", exclude=set(NOT_RESULTS))
        run = config.pop("monte_carlo")
        config["scenario"].pop("path", None)  # a recording is known by its content
        return {
            "experiment": self.name,
            "config": config,
            "seed": run["seed"],
            "chunk": self.experiment.chunk_size,
            "dtype": run["dtype"],
        }


def find_config(text: str) -> Path:
    """The file meant by a path or by the name of a shipped experiment.

    Raises:
        ConfigError: there is neither.
    """
    path = Path(text)
    if path.is_file():
        return path
    if text in config_names():
        return config_path(text)
    if path.suffix in (".yaml", ".yml") or path.exists():
        return path  # reading it says what is wrong
    near = suggest(text, config_names())
    hint = f" (did you mean '{near}'?)" if near else ""
    message = f"neither a file nor a shipped experiment{hint}; shipped: {', '.join(config_names())}"
    raise ConfigError([Problem(text, None, "", message)])


def load_experiment(text: str, overrides: Iterable[str] = ()) -> Loaded:
    """Reads, overrides and checks an experiment.

    Args:
        text: a path, or the name of a shipped experiment.
        overrides: texts `key=value`.

    Raises:
        ConfigError: with every problem found.
    """
    path = find_config(text)
    overrides = list(overrides)
    try:
        source = load_source(path)
    except ConfigError as error:
        # a file with, say, a key given twice may hold further mistakes: all are named at once
        problems = list(error.problems)
        if error.readable is not None:
            try:
                check(apply_overrides(error.readable, overrides), path)
            except ConfigError as more:
                problems += more.problems
        raise ConfigError(problems) from None
    source = apply_overrides(source, overrides)
    experiment = check(source, path)
    return Loaded(experiment_name(path, experiment), experiment, source)


def at_smoke_scale(loaded: Loaded) -> Loaded:
    """The experiment at the reduced scale of regression checks.

    Raises:
        ConfigError: its `smoke_settings` cannot be used.
    """
    settings = loaded.experiment.monte_carlo.smoke_settings
    runs = loaded.experiment.monte_carlo.smoke_runs
    texts = [f"monte_carlo.runs={runs}", *(f"{key}={value}" for key, value in settings.items())]
    source = apply_overrides(loaded.source, texts)
    if kept := loaded.experiment.monte_carlo.smoke_filters:
        known, key = list(loaded.experiment.filters), ("monte_carlo", "smoke_filters")
        unknown = [(k, UnknownName(name, known, suggest(name, known), "filter")) for k, name in enumerate(kept)]
        problems = [problem_at(source, (*key, k), str(error)) for k, error in unknown if error.name not in known]
        if problems:
            raise ConfigError(problems)
        data: Any = copy.deepcopy(source.data)
        data["filters"] = {label: settings for label, settings in data["filters"].items() if label in kept}
        source = Source(source.path, data, source.places)
    return Loaded(loaded.name, check(source, Path(loaded.source.path)), source)


def check(source: Source, path: Path) -> Experiment:
    """The experiment that a source describes.

    Raises:
        ConfigError: with every problem found.
    """
    if str(path.parent.resolve()) not in sys.path:
        sys.path.append(str(path.parent.resolve()))  # a plug-in may stand beside the file that names it
    try:
        model = model_for(source.data)
    except PluginError as error:
        raise ConfigError([problem_at(source, ("filters",), str(error))]) from error
    experiment = resolve_paths(validate(model, source), source)
    problems = list(contradictions(experiment, source))
    if problems:
        raise ConfigError(problems)
    for problem in oddities(experiment, source):
        warnings.warn(str(problem), ConfigWarning, stacklevel=3)
    return experiment


def experiment_name(path: Path, experiment: Experiment) -> str:
    """See `Loaded.name`."""
    if experiment.name is not None:
        return experiment.name
    resolved = path.resolve()
    root = SHIPPED.resolve() / "configs"
    return resolved.relative_to(root).with_suffix("").as_posix() if root in resolved.parents else path.stem


def resolve_paths(experiment: Experiment, source: Source) -> Experiment:
    """A recording is looked for beside its configuration first, then from the working directory."""
    scenario = experiment.scenario
    given = getattr(scenario, "path", None)
    if given is None:
        return experiment
    beside = Path(source.path).parent / given
    found = beside if beside.is_file() else Path(given)
    return experiment.model_copy(update={"scenario": scenario.model_copy(update={"path": str(found)})})


def problem_at(source: Source, key_path: Sequence[str | int], message: str) -> Problem:
    """A problem at the place of a key."""
    place = source.place(key_path)
    return Problem(place.file, place.line, dotted(key_path), message)


def contradictions(experiment: Experiment, source: Source) -> Iterable[Problem]:
    """What no single setting shows: names that refer to nothing, and settings that exclude each other."""

    for k, name in enumerate(experiment.metrics):
        if name in experiment.metrics[:k]:
            yield problem_at(source, ("metrics", k), f"'{name}' is listed twice")
    labels = ["truth", *experiment.filters]
    if "truth" in experiment.filters:
        yield problem_at(source, ("filters", "truth"), "a filter cannot be called 'truth'")
    if experiment.reference not in labels:
        name = UnknownName(experiment.reference, labels, suggest(experiment.reference, labels), "reference")
        yield problem_at(source, ("reference",), str(name))
    yield from mismatches(experiment, source)
    if not experiment.scenario.has_truth:
        if experiment.metrics and experiment.reference == "truth":
            message = "this scenario has no ground truth: set metrics: [] or name a filter as reference"
            yield problem_at(source, ("metrics",), message)
        if experiment.divergence is not None:
            yield problem_at(source, ("divergence",), "this scenario has no ground truth to diverge from")
    n_steps = getattr(experiment.scenario, "n_steps", None)
    if n_steps is not None and experiment.skip_steps >= n_steps:
        message = f"must be less than the {n_steps} steps of the scenario, got {experiment.skip_steps}"
        yield problem_at(source, ("skip_steps",), message)
    for name, (first, last) in experiment.segments.items():
        if not first <= last <= (n_steps or last):
            message = f"must be a first and a last scan of the {n_steps} of the scenario, got {first} and {last}"
            yield problem_at(source, ("segments", name), message)
    resolved = experiment.model_dump(mode="json")
    for group, keys in experiment.sources:
        for k, key in enumerate(keys):
            if not has_key(resolved, key.split(".")):
                yield problem_at(source, ("sources", group, k), f"'{key}' is not a setting of this file")


def oddities(experiment: Experiment, source: Source) -> Iterable[Problem]:
    """What can be used, but is probably not meant."""
    model = experiment.model
    for name in getattr(model, "unreachable", ()):
        message = "cannot be reached: the point neither starts in it nor switches to it, so its probability stays 0"
        yield problem_at(source, ("model", "motions", name), message)


def mismatches(experiment: Experiment, source: Source) -> Iterable[Problem]:
    """Scenario, filters, metrics and model that are not about the same kind of object."""
    model = experiment.model
    kind = getattr(model, "kind", "ellipse")
    what = {"ellipse": "an ellipse", "connected": "a connected object", "state_space": "a point (state_space)"}
    parts = [(("scenario",), experiment.scenario)]
    parts += [(("filters", label), settings) for label, settings in experiment.filters.items()]
    for path, settings in parts:
        theirs = getattr(settings, "tracks", "ellipse")
        if theirs != kind:
            message = f"'{settings.kind}' is about {what[theirs]}, the model about {what[kind]}"
            yield problem_at(source, (*path, "kind"), message)
        elif hasattr(settings, "faults_with"):
            for key, fault in settings.faults_with(model):
                parts = [int(part) if part.isdigit() else part for part in key.split(".")]
                yield problem_at(source, (*path, *parts), fault)
    rule = experiment.divergence
    yield from divergence_mismatches(experiment, source, kind)
    if kind != "ellipse" and experiment.reference != "truth":
        yield problem_at(source, ("reference",), f"{what[kind]} is compared with the truth only")
    for name in rule.final_mean_above if rule is not None else ():
        if name not in experiment.metrics:
            yield problem_at(source, ("divergence", "final_mean_above", name), "is not among the metrics")


def divergence_mismatches(experiment: Experiment, source: Source, kind: str) -> Iterable[Problem]:
    """Rules of divergence that the kind of object does not have."""
    rule = experiment.divergence
    if rule is None or kind == "ellipse":
        return
    has_position = kind == "state_space" and "x" in getattr(experiment.model, "states", ())
    if rule.position_error_above is not None and not has_position:
        key = ("divergence", "position_error_above")
        yield problem_at(source, key, "this object has no position; use final_mean_above")
    if rule.final_iou_below is not None:
        yield problem_at(source, ("divergence", "final_iou_below"), "IoU is that of an ellipse; use final_mean_above")


def has_key(data: Any, path: Sequence[str]) -> bool:
    """Whether nested mappings hold a value under these keys."""
    for part in path:
        if not isinstance(data, dict) or part not in data:
            return False
        data = data[part]
    return True

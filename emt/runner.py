"""Runs an experiment into a folder: chunk by chunk, resumable, with what the tables and figures need at the end."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from emt.cluster.pool import Pool
from emt.cluster.source import ChunkSource
from emt.config.errors import ConfigError
from emt.config.load import Loaded, problem_at
from emt.device import configure, environment
from emt.montecarlo.chunks import Engine, without_tracks
from emt.montecarlo.identity import identity_of
from emt.montecarlo.program import Program
from emt.montecarlo.run import mode_names
from emt.reports.connected_art import animation, is_connected
from emt.reports.estimates import estimates_table
from emt.reports.figures import over_time_figure, replay_figure, track_figure
from emt.reports.modes_art import modes_figure
from emt.reports.paper import TIMING_FILE
from emt.reports.published import summary_table
from emt.reports.replay import overview_table, steps_table
from emt.reports.summary import SUMMARY_FILE, curves, mode_shares, summarise
from emt.reports.table import Table
from emt.scenarios.data import DataError
from emt.status import FAILURE
from emt.store import RunFolder

TRACK_FIGURE = "track.png"
FEWEST_MODES = 3
"""Of the filter with most, for a figure of mode probabilities; those of two modes fit among the metrics."""
LONGEST_QUICK = 500
"""Steps of a run up to which a program compiled in a hurry saves time."""


class Progress(NamedTuple):
    """Where a run stands, for a live display."""

    stage: str
    """"compiling", "running", "reporting" or "done"."""
    detail: str
    done: int
    """Finished runs, earlier ones included."""
    total: int
    runs_per_second: float
    running: dict[str, tuple[float, float, int]]
    """Per filter: mean and standard error so far of the first metric, and failed runs."""


class Running:
    """Mean, standard error and failures so far, per filter, of the first metric."""

    def __init__(self):
        self._sums: dict[str, np.ndarray] = {}

    def add(self, labels: list[str], arrays: dict[str, np.ndarray]) -> None:
        """Takes in the arrays of a chunk."""
        for label in labels:
            values, sound = arrays[f"{label}/values"], (arrays[f"{label}/status"] & int(FAILURE)) == 0
            if values.shape[1]:
                kept = values[sound, 0]
                new = np.array([len(kept), kept.sum(), (kept**2).sum(), (~sound).sum()])
                self._sums[label] = self._sums.get(label, np.zeros(4)) + new

    def state(self) -> dict[str, tuple[float, float, int]]:
        """(mean, standard error, failed runs) per filter with a sound run."""
        result = {}
        for label, (n, total, squares, failed) in self._sums.items():
            if n > 0:
                variance = max(squares / n - (total / n) ** 2, 0.0)
                result[label] = (total / n, (variance / max(n - 1, 1)) ** 0.5, int(failed))
        return result


def build_program(loaded: Loaded) -> Program:
    """The compiled form of an experiment, its recording read and checked.

    Raises:
        ConfigError: the recording cannot be used.
    """
    configure()
    try:
        program = Program.of(loaded.experiment)
    except DataError as error:
        raise ConfigError([problem_at(loaded.source, ("scenario", error.key), str(error))]) from error
    labels = list(program.filter_params)
    problems = [
        problem_at(loaded.source, ("metrics", k), f"no filter of this experiment has '{metric.name}'")
        for k, metric in enumerate(program.metrics)
        if labels != [loaded.experiment.reference] and program.without(metric) == labels
    ]
    if any(metric.needs_mode for metric in program.metrics) and not program.tells_mode():
        problems += [
            problem_at(loaded.source, ("metrics", k), f"'{metric.name}' needs a scenario that tells the true mode")
            for k, metric in enumerate(program.metrics)
            if metric.needs_mode
        ]
    if problems:
        raise ConfigError(problems)
    return program


def metric_facts(program: Program) -> list[dict[str, Any]]:
    """Name, unit, definition, averaging of the metrics, and the filters without it, as plain data."""
    shown = ("name", "better", "definition", "over_time", "over_runs")
    return [
        {name: getattr(m, name) for name in shown}
        | {"unit": program.unit_of(m), "counted": m.counts is not None, "without": program.without(m)}
        | ({"dof": program.dof_of(m)} if m.dof is not None else {})
        for m in program.metrics
    ]


def modes_of(program: Program) -> dict[str, list[str]]:
    """Names of the modes of each filter that has some."""
    names = {}
    for label, params in program.filter_params.items():
        flt = program.make_filter[label](params, program.world.model)
        names[label] = mode_names(flt, program.world.prior)
    return {label: found for label, found in names.items() if found}


def manifest_of(loaded: Loaded, program: Program) -> dict[str, Any]:
    """What is recorded with results: the identity they depend on, and what readers need to show them."""
    experiment = loaded.experiment
    return {
        "identity": identity_of(loaded, program),
        "environment": environment(),
        "metrics": metric_facts(program),
        "filters": list(experiment.filters),
        "paper": experiment.paper,
        "title": experiment.title,
        "length_unit": experiment.length_unit,
        "steps": program.n_steps,
        "state": program.state_names(),
        "maneuvers": [list(interval) for interval in getattr(experiment.scenario, "maneuvers", ())],
        "has_truth": experiment.scenario.has_truth,
        "modes": modes_of(program),
        "true_modes": getattr(experiment.scenario, "true_modes", None),
    }


def run(
    loaded: Loaded,
    out: Path,
    *,
    runs: int | None = None,
    more: int = 0,
    figures: bool = True,
    quick: bool = False,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    pool: Pool | None = None,
) -> dict[str, Any]:
    """Runs what is missing of an experiment and writes summary, tables and figures; returns the summary.

    Args:
        out: the run folder; made if missing, continued if it belongs to the same configuration.
        runs: number of runs wanted in all; by default that of the configuration.
        more: number of runs to add to those in the folder, instead.
        figures: whether figures are drawn beside the tables.
        quick: whether programs are compiled in a hurry, for a few runs that are not long.
        pool: workers that compute instead of this process; the results are the same.

    Raises:
        ConfigError: the recording cannot be used.
        StoreError: the folder cannot be used, or belongs to another configuration.
        ClusterError: the pool cannot compute.
    """
    program = build_program(loaded)
    labels, chunk_size = list(loaded.experiment.filters), loaded.experiment.chunk_size
    with RunFolder.open(out, manifest_of(loaded, program)) as folder:
        present = sum(chunk.stop - chunk.start for chunk in folder.chunks())
        if more:
            total = max((chunk.stop for chunk in folder.chunks()), default=0) + more
        else:
            total = loaded.experiment.monte_carlo.runs if runs is None else runs
        missing = folder.missing(total, chunk_size)
        source = ChunkSource(loaded, program, pool, quick=quick and program.n_steps <= LONGEST_QUICK)
        running = Running()
        for chunk in folder.chunks():
            running.add(labels, folder.read_chunk(chunk))  # a damaged chunk is found before anything is computed

        def tell(stage: str, detail: str, done: int, rate: float = 0.0) -> None:
            on_progress(Progress(stage, detail, done, max(total, done), rate, running.state()))

        first_run: dict[str, np.ndarray] = {}
        if missing:
            source.prepare(lambda detail: tell("compiling", detail, present))
        began, done = time.perf_counter(), present
        for number, (start, stop, arrays) in enumerate(source.chunks(missing), start=1):
            if start == 0:
                first_run = {name: array[:1] for name, array in arrays.items()}
            if not loaded.experiment.traces:
                arrays = without_tracks(arrays)
            folder.write_chunk(start, stop, arrays)
            running.add(labels, arrays)
            done += stop - start
            rate = (done - present) / (time.perf_counter() - began)
            tell("running", f"chunk {number}/{len(missing)}", done, rate)
        seconds = time.perf_counter() - began
        timing = source.timing(missing, seconds) | {"run_seconds": seconds, "runs": done - present} if missing else {}
        tell("reporting", "tables and figures", done)
        if figures and not first_run and not (folder.path / TRACK_FIGURE).exists():
            source.prepare()
            ((_, _, first_run),) = source.chunks([(0, 1)])
        summary = write_reports(folder)
        if figures:
            write_figures(folder, first_run)
        if timing:
            folder.write_json(TIMING_FILE, timing)
        tell("done", "", done)
    return summary


def write_reports(folder: RunFolder) -> dict[str, Any]:
    """Summary and tables of a run folder."""
    summary, manifest = summarise(folder), folder.manifest
    folder.write_json(SUMMARY_FILE, summary)
    if manifest["metrics"]:
        folder.write_text("table.md", summary_table(summary, manifest["length_unit"]).render("markdown"))
    if manifest["identity"]["config"]["traces"]:
        folder.write_text("estimates.csv", estimates_table(folder).render("csv"))
    return summary


def write_figures(folder: RunFolder, first_run: dict[str, np.ndarray]) -> None:
    """Metrics over time, and the picture of run 0 where its tracks are at hand."""
    manifest = folder.manifest
    unit, metrics, labels = manifest["length_unit"], manifest["metrics"], manifest["filters"]
    if metrics and manifest["steps"] > 1:
        scored = {label: curves(folder, label) for label in labels}
        over_time = over_time_figure(scored, metrics, unit, maneuvers=manifest["maneuvers"])
        folder.write_bytes("over_time.png", over_time)
    heading = manifest["title"] or manifest["identity"]["experiment"]
    scenario = manifest["identity"]["config"]["scenario"]
    is_random = any(scenario.get(key) is not None for key in ("switching", "markov"))  # no two runs are alike
    if not is_random and any(len(names) >= FEWEST_MODES for names in manifest["modes"].values()):
        found = {label: mode_shares(folder, label) for label in labels if label in manifest["modes"]}
        shares = {label: (manifest["modes"][label], share.T) for label, share in found.items() if share is not None}
        if shares:
            folder.write_bytes("modes.png", modes_figure(shares, manifest["true_modes"], heading))
    if first_run:
        about = {"state": manifest["state"], "maneuvers": manifest["maneuvers"]}
        track = track_figure(first_run, labels, length_unit=unit, title=f"{heading}: run 0", **about)
        folder.write_bytes(TRACK_FIGURE, track)
        if is_connected(first_run):
            folder.write_bytes("animation.gif", animation(first_run, labels, title=labels[0]))


class Replay(NamedTuple):
    """One run computed again."""

    figure: bytes
    """PNG of truth, scans and ellipses, with the metrics over time."""
    steps: Table
    """Every filter's report and metrics at every step."""
    overview: Table
    """Metrics, flags and first failed step per filter."""


def replay(loaded: Loaded, run: int) -> Replay:
    """Computes one run again, with every step of every filter.

    Raises:
        ConfigError: the recording cannot be used.
    """
    program = build_program(loaded)
    engine = Engine(program, loaded.experiment.monte_carlo.seed, loaded.experiment.chunk_size)
    engine.compile()
    start = run - run % engine.chunk_size  # the chunk the run would belong to, so that the same lanes compute it
    arrays = {
        name: values[run - start :]
        for name, values in engine.run_chunk(start, run + 1, tracked=run + 1 - start).items()
    }
    metrics = metric_facts(program)
    labels, unit = list(loaded.experiment.filters), loaded.experiment.length_unit
    title = f"{loaded.experiment.title or loaded.name}: run {run}"
    maneuvers = getattr(loaded.experiment.scenario, "maneuvers", ())
    about = {"state": program.state_names(), "maneuvers": maneuvers}
    figure = replay_figure(arrays, labels, metrics, length_unit=unit, title=title, **about)
    overview = overview_table(arrays, labels, metrics, title, unit)
    return Replay(figure, steps_table(arrays, labels, metrics, program.state_names()), overview)

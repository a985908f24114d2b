"""From stored chunks to the summary of an experiment: every metric of every filter with its uncertainty."""

import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from emt.reports.segments import segment_numbers
from emt.status import FAILURE, Status
from emt.store import RunReader

SUMMARY_FILE = "summary.json"
MAX_BLOCKS = 512
"""Blocks of runs whose sums per step are held at a time."""


class Curve(NamedTuple):
    """A metric over time, over the runs without failure."""

    mean: np.ndarray
    """Mean over runs at each step (of the squared error, for root-mean-square metrics)."""
    std: np.ndarray
    """Standard deviation over runs at each step."""
    runs: int


class FilterResults(NamedTuple):
    """Scores of one filter in all runs, and its sums per step."""

    values: np.ndarray
    """(run, metric)."""
    status: np.ndarray
    failed_step: np.ndarray
    nis: np.ndarray
    step_sum: np.ndarray
    """(block, step, metric)."""
    step_count: np.ndarray
    """(block,)."""
    step_squares: np.ndarray
    """(step, metric)."""

    @property
    def sound(self) -> np.ndarray:
        """True for the runs without a failure bit."""
        return (self.status & int(FAILURE)) == 0


def filter_results(reader: RunReader, label: str) -> FilterResults:
    """All chunks of one filter, in run order; sums per step are merged as they come, to at most `MAX_BLOCKS` blocks."""
    per_run: dict[str, list[np.ndarray]] = {name: [] for name in ("values", "status", "failed_step", "nis")}
    sums: list[np.ndarray] = []
    counts: list[int] = []
    squares: np.ndarray | float = 0.0
    for chunk in reader.chunks():
        arrays = reader.read_chunk(chunk, [f"{label}/{name}" for name in FilterResults._fields])
        for name, parts in per_run.items():
            parts.append(arrays[f"{label}/{name}"])
        sums += list(arrays[f"{label}/step_sum"])
        counts += arrays[f"{label}/step_count"].tolist()
        squares = squares + arrays[f"{label}/step_squares"]
        if len(sums) > MAX_BLOCKS:
            sums = [sum(pair[1:], pair[0]) for pair in batched(sums, 2)]
            counts = [sum(pair) for pair in batched(counts, 2)]
    whole = {name: np.concatenate(parts) for name, parts in per_run.items()}
    return FilterResults(
        **whole, step_sum=np.stack(sums), step_count=np.array(counts), step_squares=np.asarray(squares)
    )


def batched(items: list, n: int) -> list[list]:
    """Consecutive groups of `n` items; the last may be shorter."""
    return [items[k : k + n] for k in range(0, len(items), n)]


def standard_error_of_std(values: np.ndarray) -> float:
    """Standard error of the sample standard deviation, from the sample's own fourth moment."""
    n, variance = len(values), float(np.var(values, ddof=1))
    if variance == 0.0 or n < 4:
        return math.nan
    fourth = float(np.mean((values - values.mean()) ** 4))
    return math.sqrt(max(fourth - variance**2 * (n - 3) / (n - 1), 0.0) / n) / (2.0 * math.sqrt(variance))


def rms_over_runs(results: FilterResults, column: int, first_step: int) -> tuple[float, float]:
    """Root over runs at each step, mean over steps; with a standard error by the jackknife over blocks of runs."""
    sums, counts = results.step_sum[:, first_step:, column], results.step_count
    sums, counts = sums[counts > 0], counts[counts > 0]
    value = float(np.mean(np.sqrt(sums.sum(axis=0) / counts.sum())))
    if len(counts) < 2:
        return value, math.nan
    without = np.mean(np.sqrt((sums.sum(axis=0) - sums) / (counts.sum() - counts)[:, None]), axis=1)
    blocks = len(counts)
    return value, float(np.sqrt((blocks - 1) / blocks * np.sum((without - without.mean()) ** 2)))


def pooled_over_runs(values: np.ndarray) -> tuple[float, float]:
    """Root of the mean square over runs and steps from those of runs, with its standard error to first order."""
    squares = values**2
    value = math.sqrt(float(np.mean(squares)))
    if len(values) < 2 or value == 0.0:
        return value, math.nan
    return value, float(np.std(squares, ddof=1)) / math.sqrt(len(values)) / (2.0 * value)


def peak_over_steps(results: FilterResults, column: int, first_step: int) -> tuple[float, float]:
    """Largest over steps of the root mean square over runs; with a standard error by the jackknife over blocks."""
    sums, counts = results.step_sum[:, first_step:, column], results.step_count
    sums, counts = sums[counts > 0], counts[counts > 0]
    value = float(np.sqrt((sums.sum(axis=0) / counts.sum()).max()))
    if len(counts) < 2:
        return value, math.nan
    without = np.sqrt(((sums.sum(axis=0) - sums) / (counts.sum() - counts)[:, None]).max(axis=1))
    blocks = len(counts)
    return value, float(np.sqrt((blocks - 1) / blocks * np.sum((without - without.mean()) ** 2)))


def band(dof: int, runs: int) -> tuple[float, float]:
    """Two-sided 95 % band of the mean over independent runs of a chi-square variable.

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 5.4.2.
    """
    low, high = chi2.ppf([0.025, 0.975], dof * runs) / runs
    return float(low), float(high)


def share_in_band(results: FilterResults, column: int, first_step: int, dof: int) -> float:
    """Share of the steps at which the mean over runs lies inside its band."""
    runs = int(results.step_count.sum())
    means = results.step_sum[:, first_step:, column].sum(axis=0) / runs
    low, high = band(dof, runs)
    return float(np.mean((means >= low) & (means <= high)))


def window_ratio(
    results: FilterResults, column: int, window: tuple[int, int], against: tuple[int, int]
) -> tuple[float, float]:
    """Mean of a metric over the scans of one window over that of another, with a standard error by the jackknife.

    Args:
        window, against: first and last scan, counted from 1.
    """

    def sums(bounds: tuple[int, int]) -> np.ndarray:
        return results.step_sum[:, bounds[0] - 1 : bounds[1], column].mean(axis=1)

    above, below = sums(window), sums(against)
    ratio = float(above.sum() / below.sum())
    n = len(above)
    if n < 2:
        return ratio, math.nan
    without = (above.sum() - above) / (below.sum() - below)
    return ratio, float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))


def summarise_metric(metric: dict[str, Any], results: FilterResults, column: int, first_step: int) -> dict[str, Any]:
    """value, se, std, median and runs_used of one metric; None where the runs do not allow a number."""
    values = results.values[results.sound, column]
    n = len(values)
    std = float(np.std(values, ddof=1)) if n > 1 else math.nan
    value = se = median = math.nan
    if n:
        median = float(np.median(values))
        match metric["over_runs"]:
            case "mean":
                value, se = float(np.mean(values)), std / math.sqrt(n)
            case "std":
                value, se = std, standard_error_of_std(values) if n > 1 else math.nan
            case "var":
                error = standard_error_of_std(values) if n > 1 else math.nan
                value, se = std**2, 2.0 * std * error  # to first order
            case "max":
                value = float(values.max())
            case "pooled":
                value, se = pooled_over_runs(values)
            case "peak":
                value, se = peak_over_steps(results, column, first_step)
            case "band":
                value = share_in_band(results, column, first_step, metric["dof"])
            case _:
                value, se = rms_over_runs(results, column, first_step)
    numbers = {"value": value, "se": se, "std": std, "median": median}
    return {k: (v if math.isfinite(v) else None) for k, v in numbers.items()} | {"runs_used": n}


def scored_labels(reader: RunReader) -> list[str]:
    """Filters with metrics, in the order of the configuration: none without metrics, and never the reference."""
    manifest = reader.manifest
    reference = manifest["identity"]["config"]["reference"]
    return [label for label in manifest["filters"] if manifest["metrics"] and label != reference]


def summarise(reader: RunReader) -> dict[str, Any]:
    """The summary of a run folder, as written to `summary.json`."""
    manifest = reader.manifest
    identity, metrics = manifest["identity"], manifest["metrics"]
    first_step = identity["config"]["skip_steps"]
    runs = max((chunk.stop for chunk in reader.chunks()), default=0)
    filters, flags, segments = {}, {}, {}
    for label in scored_labels(reader):
        results = filter_results(reader, label)
        filters[label] = {
            metric["name"]: summarise_metric(metric, results, column, first_step)
            for column, metric in enumerate(metrics)
            if label not in metric["without"]
        }
        if identity["config"].get("segments"):
            lacking = [metric["name"] for metric in metrics if label in metric["without"]]
            segments[label] = segment_numbers(reader, results.step_sum, results.step_count, lacking)
        names = Counter(name for bits in results.status for name in Status.names_of(int(bits)))
        failed = ~results.sound
        flags[label] = {
            "failed": int(failed.sum()),
            "failed_runs": [int(run) for run in np.flatnonzero(failed)[:20]],
            "runs_with": dict(sorted(names.items())),
            "mean_nis": float(results.nis[results.sound].mean()) if results.sound.any() else None,
        }
    return {
        "experiment": identity["experiment"],
        "runs": runs,
        "seed": identity["seed"],
        "filters": filters,
        "status": flags,
        "labels": scored_labels(reader),
        "metrics": metrics,
    } | ({"segments": segments} if segments else {})


def mode_shares(reader: RunReader, label: str) -> np.ndarray | None:
    """Mean probability (step, mode) of a filter's modes over the runs without failure; None where it is not known."""
    total: np.ndarray | float = 0.0
    runs = 0
    for chunk in reader.chunks():
        arrays = reader.read_chunk(chunk)
        if f"{label}/mode_sum" not in arrays:
            return None
        total = total + arrays[f"{label}/mode_sum"]
        runs += int(arrays[f"{label}/step_count"].sum())
    return np.asarray(total) / runs if runs else None


def curves(reader: RunReader, label: str) -> dict[str, Curve]:
    """Every metric of one filter over time; none for a reference filter."""
    if label not in scored_labels(reader):
        return {}
    results = filter_results(reader, label)
    n = int(results.step_count.sum())
    mean = results.step_sum.sum(axis=0) / max(n, 1)
    variance = np.maximum(results.step_squares / max(n, 1) - mean**2, 0.0)
    columns = {m["name"]: k for k, m in enumerate(reader.manifest["metrics"]) if label not in m["without"]}
    return {name: Curve(mean[:, k], np.sqrt(variance[:, k]), n) for name, k in columns.items()}

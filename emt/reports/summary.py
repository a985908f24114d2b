"""From stored chunks to the summary of an experiment: every metric of every filter with its uncertainty."""

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from emt.reports.gathering import (
    FilterResults,
    Total,
    column_groups,
    filter_results,
    mean_of,
    run_flags,
    step_totals,
    variance_of,
)
from emt.reports.segments import RULES, segment_numbers
from emt.store import RunReader

SUMMARY_FILE = "summary.json"


class Curve(NamedTuple):
    """A metric over time, over the runs without failure."""

    mean: np.ndarray
    """Mean over runs at each step (of the squared error, for root-mean-square metrics)."""
    std: np.ndarray
    """Standard deviation over runs at each step."""
    runs: int


def standard_error_of_std(values: np.ndarray) -> float:
    """Standard error of the sample standard deviation, from the sample's own fourth moment."""
    n, variance = len(values), variance_of(values)
    if variance == 0.0 or n < 4:
        return math.nan
    mean = values.mean()
    fourth = mean_of(values, lambda some: (some - mean) ** 4)
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
    value = math.sqrt(mean_of(values, np.square))
    if len(values) < 2 or value == 0.0:
        return value, math.nan
    return value, math.sqrt(variance_of(values, np.square) / len(values)) / (2.0 * value)


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
    low, high = 2.0 * gammaincinv(0.5 * dof * runs, [0.025, 0.975]) / runs
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
    """value, se, std, median and runs_used of one metric; None where the runs do not allow a number.

    The values of the metric are in another order afterwards.
    """
    values = results.values[column]
    n = len(values)
    std = math.sqrt(variance_of(values)) if n > 1 else math.nan
    value = se = median = math.nan
    if n:
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
        median = float(np.median(values, overwrite_input=True))  # the last to look at them: no copy
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
    stretches = identity["config"].get("segments", {})
    for label in scored_labels(reader):
        filters[label], segments[label] = {}, {}
        having = [column for column, metric in enumerate(metrics) if label not in metric["without"]]
        for columns in column_groups(reader, having):
            results = filter_results(reader, label, columns)
            for k, metric in enumerate(metrics[column] for column in columns):
                filters[label][metric["name"]] = summarise_metric(metric, results, k, first_step)
                if metric["over_runs"] in RULES:
                    numbers = segment_numbers(stretches, results.step_sum[..., k], results.step_count, metric)
                    segments[label][metric["name"]] = numbers
            del results  # before the next ones are gathered
        flags[label] = run_flags(reader, label)
    return {
        "experiment": identity["experiment"],
        "runs": runs,
        "seed": identity["seed"],
        "filters": filters,
        "status": flags,
        "labels": scored_labels(reader),
        "metrics": metrics,
    } | ({"segments": segments} if segments and stretches else {})


def mode_shares(reader: RunReader, label: str) -> np.ndarray | None:
    """Mean probability (step, mode) of a filter's modes over the runs without failure; None where it is not known."""
    total, runs = Total(), 0
    for chunk in reader.chunks():
        arrays = reader.read_chunk(chunk)
        if f"{label}/mode_sum" not in arrays:
            return None
        total.add(arrays[f"{label}/mode_sum"])
        runs += int(arrays[f"{label}/step_count"].sum())
    return total.value() / runs if runs else None


def curves(reader: RunReader, label: str) -> dict[str, Curve]:
    """Every metric of one filter over time; none for a reference filter."""
    if label not in scored_labels(reader):
        return {}
    sums, squares, n = step_totals(reader, label)
    mean = sums / max(n, 1)
    variance = np.maximum(squares / max(n, 1) - mean**2, 0.0)
    columns = {m["name"]: k for k, m in enumerate(reader.manifest["metrics"]) if label not in m["without"]}
    return {name: Curve(mean[:, k], np.sqrt(variance[:, k]), n) for name, k in columns.items()}

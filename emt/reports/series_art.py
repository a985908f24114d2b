"""Panels over time: metrics averaged over runs, and the metrics of a single run."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from emt.averaging import OF_SINGLE_RUNS
from emt.reports.axis_art import frame, limit, log_axis, needs_log, value_range
from emt.reports.numbers import unit_text
from emt.reports.plot_style import BAND, PATH, LineStyle, plain
from emt.reports.summary import Curve, band
from emt.status import FAILURE, Status

PREFERRED = (
    *("gw", "iou", "orientation_rmse_wrapped_deg", "position_rmse", "velocity_rmse", "run_rmse"),
    *("nees", "cid", "active_models", "effective_samples"),
)
READABLE = {
    "gw": "Gaussian–Wasserstein distance",
    "gw_center_sq": "squared centre distance",
    "gw_extent_sq": "squared extent distance",
    "iou": "intersection over union",
    "position_rmse": "RMS position error",
    "velocity_rmse": "RMS velocity error",
    "orientation_rmse_deg": "RMS orientation error, not wrapped",
    "orientation_rmse_wrapped_deg": "RMS orientation error",
    "moments_projected": "fraction of scans with a projection",
    "nees": "NEES",
    "nis": "NIS",
    "run_mse": "squared error",
    "run_rmse": "RMS error",
    "cid": "correct mode identification",
    "iid": "incorrect mode identification",
    "nid": "no mode identification",
    "active_models": "filters run per scan",
    "effective_samples": "effective sample size / particles",
}
Z95 = 1.96
BANDED = ("nees", "nis")
"""Metrics whose mean over runs has a chi-square band; it tells more than their spread."""
SHARES = ("cid", "iid", "nid")
"""Metrics that are 0 or 1 in a single run: their spread over runs says nothing more."""


def chosen_metrics(metrics: Sequence[Mapping[str, Any]], most: int) -> list[Mapping[str, Any]]:
    """The metrics worth a panel: at most so many, the telling ones first; none that is a spread over runs."""
    usable = [
        m for m in metrics if m["over_runs"] in OF_SINGLE_RUNS and m["over_time"] != "end" and not m.get("counted")
    ]
    if any(m["name"] == "run_rmse" for m in usable):
        usable = [m for m in usable if m["name"] != "run_mse"]  # the same curve, squared
    rank = {name: place for place, name in enumerate(PREFERRED)}
    return sorted(usable, key=lambda metric: rank.get(metric["name"], len(rank)))[:most]


def readable(metric: Mapping[str, Any]) -> str:
    """Name of a metric in words, or as registered."""
    name = str(metric["name"])
    if name.startswith("mode_") and name.endswith("_probability"):
        return f"probability of mode {name.removeprefix('mode_').removesuffix('_probability')}"
    return READABLE.get(name, name)


def name_panel(ax: Axes, name: str, unit: str) -> None:
    """Quantity above the panel, unit beside its axis: long names would not fit there."""
    ax.set_title(plain(name), loc="left", pad=4.0)
    ax.set_ylabel(plain(unit))


def grid(count: int) -> tuple[int, int]:
    """Rows and columns for so many panels."""
    return (count, 1) if count <= 3 else ((count + 1) // 2, 2)


def bands(curve: Curve, is_root: bool, is_log: bool = False) -> tuple[np.ndarray, np.ndarray | None]:
    """What is drawn of a curve.

    Args:
        curve: mean and spread over runs at every step.
        is_root: the curve is of a squared error and its root is wanted, with that of the interval.
        is_log: the interval is wanted symmetrical on a logarithmic axis, to first order.

    Returns:
        Rows mean, low and high end of the 95 % interval of the mean; and rows low and high end of one
        standard deviation over runs. The latter is None for a root and on a logarithmic axis: squared errors
        spread as widely as their mean, so the band would always reach zero.
    """
    mean, std = np.asarray(curve.mean, float), np.asarray(curve.std, float)
    half = Z95 * std / np.sqrt(max(curve.runs, 1))
    if is_log:
        factor = np.exp(half / mean)
        inner = np.stack([mean, mean / factor, mean * factor])
        return np.sqrt(inner) if is_root else inner, None
    inner = np.stack([mean, mean - half, mean + half])
    return (np.sqrt(np.maximum(inner, 0.0)), None) if is_root else (inner, np.stack([mean - std, mean + std]))


def draw_band(ax: Axes, metric: Mapping[str, Any], runs: int) -> np.ndarray:
    """The 95 % band of the mean over so many runs of a normalised square; returns its ends, none for other metrics."""
    if metric["name"] not in BANDED or not metric.get("dof") or runs < 1:
        return np.zeros(0)
    ends = band(metric["dof"], runs)
    ax.axhspan(*ends, color=BAND, lw=0.0, zorder=0.5)
    ax.axhline(metric["dof"], color=PATH, lw=0.6, zorder=0.6)
    return np.array(ends)


def empty_panel(ax: Axes, text: str) -> None:
    """Says why there is nothing to see."""
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", color="#777777")
    ax.set_xticks([])
    ax.set_yticks([])


def draw_curves(
    ax: Axes,
    metric: Mapping[str, Any],
    curves: Mapping[str, Curve],
    styles: Mapping[str, LineStyle],
    length_unit: str,
) -> None:
    """One metric of all filters, averaged over runs."""
    name_panel(ax, readable(metric), unit_text(metric["unit"], length_unit))
    curves = {label: curve for label, curve in curves.items() if curve.runs > 0}
    if not curves:
        empty_panel(ax, "no run without failure")
        return
    is_root = metric["over_time"] == "rms"
    is_log = needs_log([bands(curve, is_root)[0][0] for curve in curves.values()])
    rows = {label: bands(curve, is_root, is_log) for label, curve in curves.items()}
    if metric["name"] in (*SHARES, *BANDED):
        rows = {label: (inner, None) for label, (inner, _) in rows.items()}
    n_steps = max(inner.shape[1] for inner, _ in rows.values())
    for place, (label, (inner, outer)) in enumerate(rows.items()):
        (color, dashes), (mean, low, high) = styles[label], inner
        if n_steps == 1:
            if outer is not None:
                ax.vlines(place, outer[0], outer[1], color=color, alpha=0.3, lw=7.0)
            ax.vlines(place, low, high, color=color, lw=2.0)
            ax.plot([place], mean, "o", color=color, ms=5.0, mec="white", mew=0.8)
            continue
        steps = np.arange(1, len(mean) + 1)
        if outer is not None:
            ax.fill_between(steps, outer[0], outer[1], color=color, alpha=0.09, lw=0.0, zorder=1)
        ax.fill_between(steps, low, high, color=color, alpha=0.28, lw=0.0, zorder=2)
        ax.plot(steps, mean, color=color, ls=dashes, lw=1.3, zorder=3)
    frame(ax, n_steps)
    if n_steps == 1:
        ax.set_xticks(range(len(rows)), ["" for _ in rows])
        ax.set_xlim(-0.6, len(rows) - 0.4)
    ends = draw_band(ax, metric, max(curve.runs for curve in curves.values()))
    if is_log:
        low, high = value_range([ends, *(inner[0] for inner, _ in rows.values())])
        log_axis(ax, 0.6 * low, 1.8 * high)
        return
    if metric["name"] in SHARES:
        ax.set_ylim(-0.03, 1.03)
        return
    limit(
        ax,
        metric,
        [ends, *(inner for inner, _ in rows.values())],
        [inner if outer is None else outer for inner, outer in rows.values()],
    )


class Series(NamedTuple):
    """A quantity of a single run, step by step."""

    name: str
    unit: str
    values: dict[str, np.ndarray]
    """(step,) of every filter."""


def run_series(
    arrays: Mapping[str, np.ndarray],
    labels: Sequence[str],
    metrics: Sequence[Mapping[str, Any]],
    run: int,
    length_unit: str,
    most: int,
) -> list[Series]:
    """What is shown of every panel about a single run.

    The metrics, or, where the experiment has none, the semi-axes and the normalised innovation squared.
    """
    track = {
        label: {
            name: np.asarray(arrays[f"{label}/track/{name}"][run], float)
            for name in ("per_step", "semi_axes", "nis")
            if f"{label}/track/{name}" in arrays
        }
        for label in labels
    }
    panels: list[Series] = []
    column = {metric["name"]: k for k, metric in enumerate(metrics)}
    for metric in chosen_metrics(metrics, most):
        scored = [label for label in labels if label not in metric["without"]]
        if scored:
            values = {label: track[label]["per_step"][:, column[metric["name"]]] for label in scored}
            if metric["over_time"] == "rms":
                values = {label: np.sqrt(np.maximum(v, 0.0)) for label, v in values.items()}
            # in one run there is no mean to take the root of
            name = readable(metric).removeprefix("RMS ")
            panels.append(Series(name, unit_text(metric["unit"], length_unit), values))
    if not panels and not all("semi_axes" in track[label] for label in labels):
        panels = [Series("normalised innovation squared", "", {label: track[label]["nis"] for label in labels})]
    if not panels:
        axes = {label: np.sort(track[label]["semi_axes"], axis=1) for label in labels}
        panels = [
            Series("longer semi-axis", length_unit, {label: a[:, 1] for label, a in axes.items()}),
            Series("shorter semi-axis", length_unit, {label: a[:, 0] for label, a in axes.items()}),
            Series("normalised innovation squared", "", {label: track[label]["nis"] for label in labels}),
        ][:most]
    for panel in panels:
        for label, values in panel.values.items():
            # a step without a finite score is stored as zero
            lost = (np.asarray(arrays[f"{label}/track/status"][run]) & int(Status.NON_FINITE)) != 0
            panel.values[label] = np.where(lost, np.nan, values)
    return panels


def draw_run(ax: Axes, series: Series, failures: Mapping[str, np.ndarray], styles: Mapping[str, LineStyle]) -> None:
    """One quantity of all filters in a single run; crosses at the foot mark steps with a failure bit."""
    name_panel(ax, series.name, series.unit)
    values = series.values
    n_steps = max((len(v) for v in values.values()), default=0)
    for place, (label, value) in enumerate(values.items()):
        color, dashes = styles[label]
        steps = np.arange(1, len(value) + 1)
        if n_steps == 1:
            ax.plot([place], value, "o", color=color, ms=6.0)
        else:
            ax.plot(steps, value, color=color, ls=dashes, lw=1.2)
    frame(ax, n_steps)
    if n_steps == 1:
        ax.set_xticks(range(len(values)), ["" for _ in values])
        ax.set_xlim(-0.6, len(values) - 0.4)
    is_log = needs_log(list(values.values()))
    if is_log:
        low, high = value_range(list(values.values()))
        log_axis(ax, 0.7 * low, 1.4 * high)
    lost = [(place, label) for place, label in enumerate(values) if failures[label].any()]
    if lost:
        # a strip of its own for the crosses, below the curves
        (low, high), strip = ax.get_ylim(), 0.06 + 0.07 * len(lost)
        ax.set_ylim(low * (low / high) ** strip if is_log else low - strip * (high - low), high)
    for row, (place, label) in enumerate(lost):
        failed = np.flatnonzero(failures[label])
        at = np.full(len(failed), place) if n_steps == 1 else failed + 1
        height, color = np.full(len(failed), 0.05 + 0.06 * row), styles[label].color
        ax.plot(at, height, "x", transform=ax.get_xaxis_transform(), color=color, ms=3.5, mew=1.0)


def failures_of(arrays: Mapping[str, np.ndarray], label: str, run: int) -> np.ndarray:
    """True at the steps (step,) that carry a failure bit."""
    return (np.asarray(arrays[f"{label}/track/status"][run]) & int(FAILURE)) != 0


def failure_note(arrays: Mapping[str, np.ndarray], label: str, run: int) -> str:
    """When and how a filter failed, for people: `vb: diverged from scan 12`; empty if it did not."""
    failed = np.flatnonzero(failures_of(arrays, label, run))
    if not len(failed):
        return ""
    bits = int(np.bitwise_or.reduce(np.asarray(arrays[f"{label}/track/status"][run]))) & int(FAILURE)
    scans = f"at {len(failed)} scans, first at scan" if len(failed) > 1 else "at scan"
    return f"{label}: {', '.join(Status.names_of(bits))} {scans} {failed[0] + 1}"

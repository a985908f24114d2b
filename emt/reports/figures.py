"""Figures of an experiment: tracks with their outlines, metrics over time, and the replay of a single run.

Free of JAX and of pyplot; each function returns the bytes of a PNG, equal for equal input.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from emt.reports.connected_art import connected_legend, draw_snapshots, is_connected, movie_of
from emt.reports.ellipse_art import scene_of
from emt.reports.plot_style import BAND, MANEUVER, fixed_look, legend_below, new_figure, plain, png, styles_of
from emt.reports.series_art import (
    BANDED,
    chosen_metrics,
    draw_curves,
    draw_run,
    failure_note,
    failures_of,
    grid,
    run_series,
)
from emt.reports.state_art import draw_flight, flight_legend, flight_of, flight_size, is_state_space
from emt.reports.summary import Curve
from emt.reports.track_art import draw_track, track_legend, track_size

LONG, SMOOTHED_SCANS = 2000, 51
"""Longer runs than this many scans are shown as moving averages over so many."""

__all__ = ["over_time_figure", "png", "replay_figure", "track_figure"]


def track_figure(
    arrays: Mapping[str, np.ndarray],
    labels: Sequence[str],
    run_index: int = 0,
    length_unit: str = "m",
    title: str = "",
    state: Sequence[str] = (),
    maneuvers: Sequence[Sequence[float]] = (),
) -> bytes:
    """The path, scans and outlines of one run, with close-ups where the object turns.

    Of a point, its path with close-ups where filters differ, or its state over time.

    Args:
        arrays: tracks and scans of a chunk by name, e.g. `vb/track/center` (run, step, 2); with
            `truth/position` and so on where there is a truth. Lengths in `length_unit`, angles in radians.
        labels: filters, in the order that fixes their colours.
        run_index: row of the arrays.
        length_unit: unit of the axes.
        title: heading.
        state: names of the entries of the state of a point.
        maneuvers: first and last scan number of each true manoeuvre of a point.

    Returns:
        A PNG.
    """
    with fixed_look():
        styles = styles_of(labels)
        if is_state_space(arrays):
            flight = flight_of(arrays, labels, run_index, state, maneuvers)
            figure = new_figure(*flight_size(flight))
            draw_flight(figure, flight, styles, length_unit, {})
            legend_below(figure, *flight_legend(flight, styles))
            figure.suptitle(plain(title))
            return png(figure)
        if is_connected(arrays):
            figure = new_figure(9.6, 5.6)
            draw_snapshots(figure, movie_of(arrays, labels, run_index), styles, length_unit, 2, 4)
            legend_below(figure, *connected_legend(styles))
            figure.suptitle(plain(title))
            return png(figure)
        scene = scene_of(arrays, labels, run_index)
        figure = new_figure(*track_size(scene))
        draw_track(figure, scene, styles, length_unit, {})
        legend_below(figure, *track_legend(scene, styles))
        if title:
            figure.suptitle(plain(title))
        return png(figure)


def over_time_figure(
    curves: Mapping[str, Mapping[str, Curve]],
    metrics: Sequence[Mapping[str, Any]],
    length_unit: str,
    dt_label: str = "scan",
    max_panels: int = 6,
    title: str = "",
    maneuvers: Sequence[Sequence[float]] = (),
) -> bytes:
    """Metrics over time: mean over runs, its 95 % interval, and one standard deviation over runs.

    NEES and NIS come with the chi-square band of a consistent filter. Curves far apart share a logarithmic axis.

    Args:
        curves: curves by filter and metric; the order of filters fixes their colours, so give one without
            curves an empty place. Of a metric whose `over_time` is "rms" the curve is of the squared error;
            its root is shown, without standard deviation.
        metrics: name, unit, over_time and over_runs of each metric.
        length_unit: stands for `L` in the units.
        dt_label: what a step is called.
        max_panels: at most so many metrics.
        title: heading, before the number of runs.
        maneuvers: first and last scan number of each true manoeuvre, shaded.

    Returns:
        A PNG.
    """
    with fixed_look():
        styles = styles_of(list(curves))
        n_steps = max((len(curve.mean) for c in curves.values() for curve in c.values()), default=0)
        width = SMOOTHED_SCANS if n_steps >= LONG else 1
        if width > 1:
            metrics = [{**metric, "dof": None} for metric in metrics]  # moving averages have narrower bands
        curves = {label: {name: smoothed(c, width) for name, c in named.items()} for label, named in curves.items()}
        told = [m for m in metrics if any(m["name"] in c and c[m["name"]].mean.any() for c in curves.values())]
        chosen = chosen_metrics(told, max_panels)  # nothing but zeros needs no panel
        rows, columns = grid(max(len(chosen), 1))
        figure = new_figure(7.2 if columns == 1 else 9.6, 0.9 + (2.1 if columns == 1 else 2.5) * rows)
        panels: list[Axes] = list(figure.subplots(rows, columns, squeeze=False).ravel())
        for ax, metric in zip(panels, chosen, strict=False):
            draw_curves(
                ax,
                metric,
                {label: c[metric["name"]] for label, c in curves.items() if metric["name"] in c},
                styles,
                length_unit,
            )
            for first, last in maneuvers:
                ax.axvspan(first, last, color=MANEUVER, lw=0.0, zorder=0)
        if not chosen:
            panels[0].set_axis_off()
            panels[0].text(0.5, 0.5, "no metrics", ha="center", va="center", color="#777777")
        _label_bottom(panels[: max(len(chosen), 1)], columns, plain(dt_label))
        for ax in panels[max(len(chosen), 1) :]:
            ax.set_axis_off()
        runs = {label: max(curve.runs for curve in c.values()) for label, c in curves.items() if c}
        names = [label if len(set(runs.values())) == 1 else f"{label}, {runs[label]} runs" for label in runs]
        marker = "o" if all(len(curve.mean) == 1 for c in curves.values() for curve in c.values()) else None
        handles: list[Artist] = [
            Line2D([], [], color=color, ls="none" if marker else dashes, marker=marker, lw=1.6)
            for color, dashes in (styles[label] for label in runs)
        ]
        if maneuvers:
            handles.append(Patch(color=MANEUVER))
            names.append("true manoeuvre")
        if any(metric["name"] in BANDED and metric.get("dof") for metric in chosen):
            handles.append(Patch(color=BAND))
            names.append("95 % band")
        legend_below(figure, handles, names)
        counted = _count_text(list(runs.values())) + (f"; averaged over {width} {dt_label}s" if width > 1 else "")
        figure.suptitle(plain(f"{title} – {counted}" if title else counted))
        return png(figure)


def replay_figure(
    arrays: Mapping[str, np.ndarray],
    labels: Sequence[str],
    metrics: Sequence[Mapping[str, Any]],
    run_index: int = 0,
    length_unit: str = "m",
    title: str = "",
    dt_label: str = "scan",
    max_panels: int = 4,
    state: Sequence[str] = (),
    maneuvers: Sequence[Sequence[float]] = (),
) -> bytes:
    """One run in detail: its track on the left, its scores scan by scan on the right.

    Steps with a failure bit carry a cross, at the filter's centre and at the foot of each panel. Without
    metrics the panels show semi-axes and normalised innovation squared.

    Args:
        arrays: as for `track_figure`, with `vb/track/per_step` (run, step, metric) in the order of `metrics`.
        labels: filters, in the order that fixes their colours.
        metrics: name, unit, over_time and over_runs of every stored metric.
        run_index: row of the arrays.
        length_unit: unit of lengths.
        title: heading.
        dt_label: what a step is called.
        max_panels: at most so many panels on the right.
        state, maneuvers: as for `track_figure`.

    Returns:
        A PNG.
    """
    with fixed_look():
        styles = styles_of(labels)
        series = run_series(arrays, labels, metrics, run_index, length_unit, max_panels)
        failures = {label: failures_of(arrays, label, run_index) for label in labels}
        figure = new_figure(12.0, 6.6)
        left, right = np.ravel(figure.subfigures(1, 2, squeeze=False, width_ratios=(1.15, 1.0)))
        if is_state_space(arrays):
            flight = flight_of(arrays, labels, run_index, state, maneuvers)
            draw_flight(left, flight, styles, length_unit, failures)
            legend = flight_legend(flight, styles)
        elif is_connected(arrays):
            draw_snapshots(left, movie_of(arrays, labels, run_index), styles, length_unit, 3, 2)
            legend = connected_legend(styles)
        else:
            scene = scene_of(arrays, labels, run_index)
            draw_track(left, scene, styles, length_unit, failures)
            legend = track_legend(scene, styles)
        panels: list[Axes] = list(right.subplots(len(series), 1, squeeze=False, sharex=True).ravel())
        for ax, panel in zip(panels, series, strict=True):
            draw_run(ax, panel, failures, styles)
        _label_bottom(panels, 1, plain(dt_label))
        notes = [note for label in labels if (note := failure_note(arrays, label, run_index))]
        if notes:
            shown = notes[:3] + [f"and {len(notes) - 3} more"] * (len(notes) > 3)
            right.suptitle(plain("× failed – " + "\n".join(shown)), fontsize=8.5, color="#A00000")
        legend_below(figure, *legend)
        if title:
            figure.suptitle(plain(title))
        return png(figure)


def smoothed(curve: Curve, width: int) -> Curve:
    """Moving averages of mean and spread; shorter ones at the ends."""
    if width == 1:
        return curve
    kernel = np.ones(width)
    count = np.convolve(np.ones(len(curve.mean)), kernel, "same")
    mean, std = (np.convolve(values, kernel, "same") / count for values in (curve.mean, curve.std))
    return Curve(mean, std, curve.runs)


def _count_text(runs: Sequence[int]) -> str:
    """`mean over 1000 runs`, or over their range where failures differ."""
    low, high = min(runs, default=0), max(runs, default=0)
    counted = f"{high}" if low == high else f"{low} to {high}"
    runs_word = "run" if high == 1 else "runs"
    return f"mean over {counted} {runs_word} with its 95 % interval; light: one standard deviation over runs"


def _label_bottom(panels: Sequence[Axes], columns: int, text: str) -> None:
    """Names the time axis once per column."""
    for ax in panels[-columns:]:
        if any(tick.get_text() for tick in ax.get_xticklabels()):
            ax.set_xlabel(text)

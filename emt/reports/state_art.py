"""Drawing one run of a point: its path in the plane with close-ups, or its state over time."""

import string
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from emt.reports.axis_art import frame
from emt.reports.connected_art import is_connected
from emt.reports.ellipse_art import Box, peaks
from emt.reports.plot_style import MANEUVER, PATH, POINT, LineStyle, plain, with_unit
from emt.reports.series_art import name_panel

MOST_PANELS = 4
CLOSE_UPS = 3
MARGIN = 0.05
"""Free border of a window, in its larger side."""
FLATTEST = 0.2
"""Least ratio of the sides of a window."""
ERRORS = 10.0
"""Side of a close-up, in typical errors of a filter."""
SMALL = 0.05
"""Close-ups are of use only if they are smaller than this part of the main window."""
TINY = 0.012
"""Close-ups smaller than this part of the main window get a marker there as well."""
TALL = 1.25
"""Height over width from which on close-ups stand beside the main panel."""
CLIP = 20.0
"""Places further out than this many window sizes are left out; the renderer has limits."""


class Flight(NamedTuple):
    """Everything drawable of one run of a point."""

    names: tuple[str, ...]
    """Of the entries of the state."""
    truth: np.ndarray
    """(step, n)."""
    filters: dict[str, np.ndarray]
    """(step, n) of every filter."""
    places: np.ndarray
    """(step, 2): where the measurements say that the point is; NaN where they do not."""
    maneuvers: Sequence[Sequence[float]]
    """First and last scan of each true manoeuvre."""

    @property
    def plane(self) -> list[int]:
        """Places of x and y in the state; empty if it does not have both."""
        return [self.names.index(name) for name in "xy"] if {"x", "y"} <= set(self.names) else []

    @property
    def path(self) -> np.ndarray:
        """(step, 2): true places in the plane."""
        return self.truth[:, self.plane]


class CloseUp(NamedTuple):
    """A small window about the true place at one step."""

    step: int
    box: Box


def is_state_space(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether the arrays of a run are those of a point with a state."""
    return "truth/state" in arrays and not is_connected(arrays)


def flight_of(
    arrays: Mapping[str, np.ndarray],
    labels: Sequence[str],
    run: int,
    state: Sequence[str],
    maneuvers: Sequence[Sequence[float]] = (),
) -> Flight:
    """One run of the arrays of a chunk; `state` names the entries of the state."""
    truth = np.asarray(arrays["truth/state"][run], float)
    nowhere = np.full((len(truth), 2), np.nan)
    places = np.asarray(arrays["scans/places"][run], float) if "scans/places" in arrays else nowhere
    filters = {label: np.asarray(arrays[f"{label}/track/mean"][run], float) for label in labels}
    names = tuple(state) or tuple(f"entry {k + 1}" for k in range(truth.shape[1]))
    return Flight(names, truth, filters, places, maneuvers)


def flight_window(flight: Flight) -> Box:
    """The window that shows truth and measurements; filters that are far off do not widen it."""
    seen = np.concatenate([flight.path, flight.places])
    seen = seen[np.isfinite(seen).all(axis=1)]
    low, high = seen.min(axis=0), seen.max(axis=0)
    side = float((high - low).max()) or 1.0
    middle = 0.5 * (low + high)
    half = np.maximum(0.5 * (high - low) + MARGIN * side, 0.5 * FLATTEST * side)
    return Box(*(float(middle[k] + sign * half[k]) for k in (0, 1) for sign in (-1, 1)))


def close_ups(flight: Flight, box: Box) -> list[CloseUp]:
    """Windows where filters differ most, or a single one errs most; none that are hardly smaller than the main one."""
    path, n_steps = flight.path, len(flight.truth)
    if n_steps < 2 or not flight.filters:
        return []
    means = np.stack([mean[:, flight.plane] for mean in flight.filters.values()])
    means = np.where(np.isfinite(means), means, path + CLIP * max(box.width, box.height))
    errors = _typical_distance(means, path)
    apart = _typical_distance(means, np.median(means, axis=0)) if len(means) > 1 else errors
    side, largest = ERRORS * np.maximum(errors, np.median(errors)), SMALL * max(box.width, box.height)
    if np.median(side) > largest:
        return []
    found = peaks(np.where(side < largest, apart, 0.0), CLOSE_UPS, max(n_steps // 6, 1))
    return [
        CloseUp(int(k), Box(x - side[k] / 2, x + side[k] / 2, y - side[k] / 2, y + side[k] / 2))
        for k, (x, y) in zip(found, path[found], strict=True)
    ]


def _typical_distance(means: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Median over filters of the distance (step,) of their means (filter, step, 2) from places (step, 2)."""
    gap = means - places
    return np.median(np.hypot(gap[..., 0], gap[..., 1]), axis=0)


def flight_size(flight: Flight) -> tuple[float, float]:
    """Width and height of a figure of one run (inches)."""
    if not flight.plane:
        return 7.4, 1.1 + 2.0 * min(len(flight.names), MOST_PANELS)
    box = flight_window(flight)
    ratio = box.height / box.width
    if not close_ups(flight, box):
        return 7.4, float(np.clip(6.6 * ratio, 1.8, 6.4)) + 1.1
    if ratio > TALL:
        return 7.4, float(np.clip(4.4 * ratio, 5.5, 7.5)) + 0.9
    return 7.4, float(np.clip(6.6 * ratio, 1.8, 5.0)) + 3.6


def _panels(container: Any, box: Box, count: int) -> tuple[Axes, list[Axes]]:
    """Main panel and so many small ones: below it, or beside the main panel of a tall path."""
    if not count:
        return container.subplots(1, 1), []
    if box.height > TALL * box.width:
        cells = container.add_gridspec(count, 2, width_ratios=(1.7, 1.0))
        return container.add_subplot(cells[:, 0]), [container.add_subplot(cells[k, 1]) for k in range(count)]
    ratio = float(np.clip(2.9 * box.height / box.width, 0.8, 2.2))
    cells = container.add_gridspec(2, count, height_ratios=(ratio, 1.0))
    return container.add_subplot(cells[0, :]), [container.add_subplot(cells[1, k]) for k in range(count)]


def draw_flight(
    container: Any,
    flight: Flight,
    styles: Mapping[str, LineStyle],
    length_unit: str,
    failures: Mapping[str, np.ndarray],
) -> None:
    """One run into a figure or a part of one: its path if the state has x and y, else its state over time."""
    if not flight.plane:
        _draw_states(container, flight, styles)
        return
    box = flight_window(flight)
    details = close_ups(flight, box)
    main, others = _panels(container, box, len(details))
    _draw_paths(main, flight, styles, box, "")
    for label, failed in failures.items():
        places = flight.filters[label][failed][:, flight.plane]
        inside = np.abs(places - [box.x0 + box.width / 2, box.y0 + box.height / 2]) < [box.width / 2, box.height / 2]
        main.plot(*places[inside.all(axis=1)].T, "x", color=styles[label].color, ms=5.0, mew=1.3, zorder=5)
    main.set_xlabel(with_unit("x", length_unit))
    main.set_ylabel(with_unit("y", length_unit))
    for ax, detail, letter in zip(others, details, string.ascii_lowercase, strict=False):
        _draw_paths(ax, flight, styles, detail.box, ".")
        ax.set_title(f"({letter})  scan {detail.step + 1}", pad=3.0)
        ax.xaxis.set_major_locator(MaxNLocator(3))
        ax.yaxis.set_major_locator(MaxNLocator(4))
        close = detail.box
        main.add_patch(Rectangle((close.x0, close.y0), close.width, close.height, fill=False, ec="#555555", lw=0.6))
        if close.width < TINY * max(box.width, box.height):
            main.plot(*flight.path[detail.step], "s", ms=5.0, mfc="none", mec="#333333", mew=0.8, zorder=6)
        dx, dy = np.gradient(flight.path, axis=0)[detail.step]
        left = dx * dy > 0.0  # off the path
        main.annotate(
            letter,
            (close.x0 if left else close.x1, close.y1),
            xytext=(-5 if left else 5, 0),
            textcoords="offset points",
            ha="right" if left else "left",
            fontsize=8,
            color="#333333",
        )


def _turning(flight: Flight) -> list[np.ndarray]:
    """The true path (step, 2) from the scan before each manoeuvre to its last."""
    return [flight.path[max(int(first) - 2, 0) : int(last)] for first, last in flight.maneuvers]


def _draw_paths(ax: Axes, flight: Flight, styles: Mapping[str, LineStyle], box: Box, marker: str) -> None:
    """Truth, measurements and filters in a window, at equal scales; `marker` stands at every scan."""
    alone = "o" if len(flight.truth) == 1 else marker
    for stretch in _turning(flight):
        ax.plot(*stretch.T, color=MANEUVER, lw=9.0, solid_capstyle="round", zorder=1)
    ax.plot(*flight.path.T, color=PATH, lw=3.0, alpha=0.45, marker=alone, ms=9.0, mec="none", zorder=2)
    ax.scatter(*flight.places.T, s=9.0 if marker else 3.0, color=POINT, alpha=0.75, linewidths=0.0, zorder=3)
    span, middle = max(box.width, box.height), np.array([box.x0 + box.width / 2, box.y0 + box.height / 2])
    for label, (color, dashes) in styles.items():
        means = flight.filters[label][:, flight.plane]
        near = np.abs(means - middle).max(axis=1) < CLIP * span  # NaN compares false
        means = np.where(near[:, None], means, np.nan)
        ax.plot(*means.T, color=color, ls=dashes, lw=1.2, marker=alone, ms=5.0, mec="none", zorder=4)
    ax.set_xlim(box.x0, box.x1)
    ax.set_ylim(box.y0, box.y1)
    ax.set_aspect("equal")


def _draw_states(container: Any, flight: Flight, styles: Mapping[str, LineStyle]) -> None:
    """Entries of the state over scans, one panel each."""
    count, n_steps = min(len(flight.names), MOST_PANELS), len(flight.truth)
    panels: list[Axes] = list(container.subplots(count, 1, squeeze=False, sharex=True).ravel())
    steps = np.arange(1, n_steps + 1)
    alone = "o" if n_steps == 1 else ""
    for k, ax in enumerate(panels):
        true = flight.truth[:, k]
        name_panel(ax, flight.names[k], "")
        ax.plot(steps, true, color=PATH, lw=3.0, alpha=0.45, marker=alone, ms=9.0, mec="none", zorder=2)
        side = float(np.ptp(true)) or 1.0
        low, high = true.min() - 0.15 * side, true.max() + 0.15 * side
        for label, (color, dashes) in styles.items():
            mean = flight.filters[label][:, k]
            shown = np.where(np.abs(mean - 0.5 * (low + high)) < CLIP * side, mean, np.nan)
            ax.plot(steps, shown, color=color, ls=dashes, lw=1.2, marker=alone, ms=5.0, mec="none", zorder=3)
        frame(ax, n_steps)
        ax.set_ylim(low, high)
        for first, last in flight.maneuvers:
            ax.axvspan(first, last, color=MANEUVER, lw=0.0, zorder=0)
    panels[-1].set_xlabel(plain("scan"))


def flight_legend(flight: Flight, styles: Mapping[str, LineStyle]) -> tuple[list[Artist], list[str]]:
    """Handles and names of everything drawn."""
    handles: list[Artist] = [Line2D([], [], color=PATH, lw=3.0, alpha=0.45)]
    names = ["truth"]
    if len(flight.maneuvers):
        handles.append(Patch(color=MANEUVER))
        names.append("true manoeuvre")
    if flight.plane and np.isfinite(flight.places).any():
        handles.append(Line2D([], [], color=POINT, ls="none", marker=".", ms=4.0))
        names.append("measurements")
    handles += [Line2D([], [], color=color, ls=dashes, lw=1.6) for color, dashes in styles.values()]
    return handles, [*names, *styles]

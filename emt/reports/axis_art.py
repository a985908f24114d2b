"""Axes of panels over time: scans along, and values up to a range that shows what matters, linear or logarithmic."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, StrMethodFormatter

WIDE = 20.0
"""An axis is logarithmic if its largest value is more than so many times the least median over scans of a filter."""


def frame(ax: Axes, n_steps: int) -> None:
    """Grid, open frame, and whole scan numbers."""
    ax.grid(True)
    ax.spines[["top", "right"]].set_visible(False)
    if n_steps > 1:
        ax.xaxis.set_major_locator(MaxNLocator(8, integer=True, steps=[1, 2, 5, 10]))
        ax.set_xlim(1 - 0.01 * n_steps, n_steps + 0.01 * n_steps)


def value_range(arrays: Sequence[np.ndarray]) -> tuple[float, float]:
    """Least and greatest finite value; infinite the wrong way round where there is none."""
    values = np.concatenate([array.ravel() for array in arrays])
    values = values[np.isfinite(values)]
    return float(values.min(initial=np.inf)), float(values.max(initial=-np.inf))


def needs_log(rows: Sequence[np.ndarray]) -> bool:
    """Whether the curves (step,) of all filters are positive, and too far apart for a common linear axis."""
    rows = [row[np.isfinite(row)] for row in rows if np.isfinite(row).any()]
    if not rows:
        return False
    low, high = value_range(rows)
    return low > 0.0 and high > WIDE * min(float(np.median(row)) for row in rows)


def log_axis(ax: Axes, low: float, high: float) -> None:
    """A logarithmic value axis between these ends, with plain numbers where powers of ten would be too few."""
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    if high < 1e3 * low:
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_locator(NullLocator())


def limit(ax: Axes, metric: Mapping[str, Any], inner: Sequence[np.ndarray], outer: Sequence[np.ndarray]) -> None:
    """Limits of the value axis that show all of `inner` and, within reason, of `outer`."""
    low, high = value_range(inner)
    wide_low, wide_high = value_range(outer)
    if not np.isfinite([low, high, wide_low, wide_high]).all():
        return
    span = max(high - low, 1e-3 * abs(high), 1e-12)
    # a heavy tail over runs must not press the curves together
    bottom, top = max(min(low, wide_low), low - 0.6 * span), min(max(high, wide_high), high + 0.6 * span)
    bottom, top = bottom - 0.04 * span, top + 0.04 * span
    if low >= 0.0:
        bottom = max(bottom, 0.0)
    if metric["name"] == "iou":
        top = min(top, 1.0)
    if bottom < top:
        ax.set_ylim(bottom, top)

"""How probable multiple-model filters hold their modes over time, beside the true mode."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from emt.reports.plot_style import COLOURS, fixed_look, legend_below, new_figure, plain, png

MOST_FILTERS = 6
TALLEST = 7.5
"""Height of a column of panels (inches) above which there are two."""
COLOUR_MAP, TRUE_MODE = "Blues", COLOURS[1]

Shares = tuple[Sequence[str], np.ndarray]
"""Names of the modes, and their mean probabilities (mode, step)."""


def modes_figure(shares: Mapping[str, Shares], true_modes: Sequence[str] | None = None, title: str = "") -> bytes:
    """Heat maps of mode probabilities over scans, one for each filter.

    Args:
        shares: names and mean probabilities over runs of the modes, by filter; the first six are shown.
        true_modes: name of the true mode at every step, where all runs have the same.
        title: heading.

    Returns:
        A PNG.
    """
    shown = list(shares.items())[:MOST_FILTERS]
    with fixed_look():
        most = max((len(names) for _, (names, _) in shown), default=1)
        height = float(np.clip(0.16 * most + 0.5, 1.2, 3.2))
        columns = 1 if height * len(shown) < TALLEST else 2
        rows = max(-(-len(shown) // columns), 1)
        figure = new_figure(7.2 if columns == 1 else 9.6, 0.9 + height * rows)
        panels: list[Axes] = list(figure.subplots(rows, columns, squeeze=False, sharex=True).ravel())
        image = None
        for ax, (label, (names, probability)) in zip(panels, shown, strict=False):
            n_modes, n_steps = probability.shape
            extent = (0.5, n_steps + 0.5, n_modes - 0.5, -0.5)
            look = {"cmap": COLOUR_MAP, "vmin": 0.0, "vmax": 1.0, "aspect": "auto", "interpolation": "nearest"}
            image = ax.imshow(probability, extent=extent, **look)
            if true_modes is not None:
                ax.plot(*true_steps(names, true_modes), color=TRUE_MODE, lw=1.0)
            ax.set_title(plain(label), loc="left", pad=4.0)
            ax.set_yticks(range(n_modes), [plain(name) for name in names])
            ax.tick_params(axis="y", length=0.0)
            ax.set_ylim(n_modes - 0.5, -0.5)
            ax.xaxis.set_major_locator(MaxNLocator(8, integer=True, steps=[1, 2, 5, 10]))
        for ax in panels[len(shown) :]:
            ax.set_axis_off()
        for ax in panels[max(len(shown) - columns, 0) : len(shown)]:
            ax.set_xlabel("scan")
            ax.tick_params(axis="x", labelbottom=True)
        if image is not None:
            figure.colorbar(image, ax=panels, label="mean probability over runs", aspect=40, pad=0.01)
        if true_modes is not None:
            legend_below(figure, [Line2D([], [], color=TRUE_MODE, lw=1.4)], ["true mode"])
        if title:
            figure.suptitle(plain(title))
        return png(figure)


def true_steps(names: Sequence[str], true_modes: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the line of the true mode: scans, and places in `names`, NaN where a filter has no such mode."""
    row = np.array([names.index(mode) if mode in names else np.nan for mode in true_modes])
    scans = np.arange(1, len(row) + 1)
    return np.stack([scans - 0.5, scans + 0.5], axis=1).ravel(), np.repeat(row, 2)

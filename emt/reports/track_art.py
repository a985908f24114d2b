"""Drawing the track of one run: truth, scans and outlines in a main panel and close-ups."""

import string
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from emt.reports.ellipse_art import Box, Scene, neighbours, shown_steps, window, zoom_steps
from emt.reports.plot_style import PATH, POINT, TRUTH_EDGE, TRUTH_FILL, LineStyle, with_unit

CLIP = 20.0
"""Outlines further out than this many window sizes are left out; the renderer has limits."""


def _has_zooms(scene: Scene, box: Box) -> bool:
    """Close-ups are of use only where the object is small in the main panel."""
    return max(box.width, box.height) > 6.0 * scene.length


def _main_box(scene: Scene) -> Box:
    return window(scene, np.arange(len(scene.path)), 0.25 * scene.length)


def track_size(scene: Scene) -> tuple[float, float]:
    """Width and height of a track figure (inches), from the proportions of the path."""
    box = _main_box(scene)
    ratio = box.height / box.width
    if not _has_zooms(scene, box):
        return 6.4, float(np.clip(5.6 * ratio, 3.0, 6.4)) + 0.9
    if ratio > 1.25:
        return 7.4, float(np.clip(4.6 * ratio, 5.5, 7.5)) + 0.7
    return 7.4, float(np.clip(6.8 * ratio, 1.8, 5.0)) + 3.3


def draw_track(
    container: Any,
    scene: Scene,
    styles: Mapping[str, LineStyle],
    length_unit: str,
    failures: Mapping[str, np.ndarray],
) -> None:
    """Main panel and close-ups, into a figure or a part of one."""
    box = _main_box(scene)
    steps = np.arange(len(scene.path)) if len(scene.path) == 1 else shown_steps(scene)
    middles = zoom_steps(scene, steps) if _has_zooms(scene, box) else np.zeros(0, int)
    if not len(middles):
        main, zooms = container.subplots(1, 1), []
    elif box.height > 1.25 * box.width:
        # a tall path leaves room beside it
        cells = container.add_gridspec(len(middles), 2, width_ratios=(1.9, 1.0))
        main = container.add_subplot(cells[:, 0])
        zooms = [container.add_subplot(cells[k, 1]) for k in range(len(middles))]
    else:
        ratio = float(np.clip(2.9 * box.height / box.width, 0.8, 2.2))
        cells = container.add_gridspec(2, len(middles), height_ratios=(ratio, 1.0))
        main = container.add_subplot(cells[0, :])
        zooms = [container.add_subplot(cells[1, k]) for k in range(len(middles))]
    groups = [neighbours(scene, int(k)) for k in middles]
    boxes = [window(scene, group, 0.12 * scene.length, square=True) for group in groups]
    for close in boxes:
        box = box.around(close)
    large = not len(middles)
    _draw_scene(main, scene, steps, styles, box, 1.5 if large else 0.9, 9.0 if large else 2.2)
    _mark_failures(main, scene, styles, failures)
    main.set_xlabel(with_unit("x", length_unit))
    main.set_ylabel(with_unit("y", length_unit))
    for ax, middle, group, close, letter in zip(zooms, middles, groups, boxes, string.ascii_lowercase, strict=False):
        _draw_scene(ax, scene, group, styles, close, 1.4, 5.0)
        ax.set_title(f"({letter})  scan {middle + 1}", pad=3.0)
        ax.xaxis.set_major_locator(MaxNLocator(3))
        ax.yaxis.set_major_locator(MaxNLocator(4))
        main.add_patch(Rectangle((close.x0, close.y0), close.width, close.height, fill=False, ec="#555555", lw=0.6))
        main.annotate(
            letter,
            (close.x0, close.y1),
            xytext=(2, -2),
            textcoords="offset points",
            va="top",
            fontsize=8,
            color="#333333",
        )


def _draw_scene(
    ax: Axes,
    scene: Scene,
    steps: np.ndarray,
    styles: Mapping[str, LineStyle],
    box: Box,
    width: float,
    dot: float,
) -> None:
    """Truth, points, paths and outlines of some steps in a window, at equal scales."""
    if scene.truth is not None:
        ax.add_collection(
            PolyCollection(
                list(scene.truth[steps]),
                facecolors=TRUTH_FILL,
                edgecolors=TRUTH_EDGE,
                linewidths=0.6,
                zorder=1,
            ),
            autolim=False,
        )
    if len(scene.path) > 1 and (scene.truth is not None or width < 1.0):
        # the mean of a scan jumps about too much for a close-up
        ax.plot(*scene.path.T, color=PATH, lw=0.8 if scene.truth is not None else 0.5, zorder=2)
    points = scene.points[steps].reshape(-1, 2)
    ax.scatter(points[:, 0], points[:, 1], s=dot, color=POINT, alpha=0.75, linewidths=0.0, zorder=3)
    span, middle = max(box.width, box.height), np.array([box.x0 + box.width / 2, box.y0 + box.height / 2])
    for label, (color, dashes) in styles.items():
        outlines = scene.outlines[label][steps]
        near = np.abs(outlines - middle).max(axis=(1, 2)) < CLIP * span  # NaN compares false
        ax.add_collection(
            LineCollection(list(outlines[near]), colors=color, linestyles=[dashes], linewidths=width, zorder=4),
            autolim=False,
        )
    ax.set_xlim(box.x0, box.x1)
    ax.set_ylim(box.y0, box.y1)
    ax.set_aspect("equal")


def _mark_failures(ax: Axes, scene: Scene, styles: Mapping[str, LineStyle], failures: Mapping[str, np.ndarray]) -> None:
    """A cross at the centre a filter reported in each failed step; those outside the window are not shown."""
    low, high = np.array([ax.get_xlim(), ax.get_ylim()]).T
    for label, failed in failures.items():
        centers = scene.centers[label][failed]
        inside = ((centers > low) & (centers < high)).all(axis=1)
        ax.plot(*centers[inside].T, "x", color=styles[label].color, ms=5.0, mew=1.3, zorder=5)


def track_legend(scene: Scene, styles: Mapping[str, LineStyle]) -> tuple[list[Artist], list[str]]:
    """Handles and names of everything drawn."""
    handles: list[Artist] = []
    names: list[str] = []
    if scene.truth is not None:
        handles.append(Patch(facecolor=TRUTH_FILL, edgecolor=TRUTH_EDGE, linewidth=0.6))
        names.append("truth")
    if np.isfinite(scene.points).any():
        handles.append(Line2D([], [], color=POINT, ls="none", marker=".", ms=4.0))
        names.append("detections")
    if scene.truth is None and len(scene.path) > 1:
        handles.append(Line2D([], [], color=PATH, lw=0.8))
        names.append("their mean" if names else "path")
    for label, (color, dashes) in styles.items():
        handles.append(Line2D([], [], color=color, ls=dashes, lw=1.6))
        names.append(label)
    return handles, names

"""Drawing connected objects of one run: snapshots over time, and an animation."""

import io
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse, Patch, Rectangle
from PIL import Image

from emt.reports.plot_style import POINT, TRUTH_EDGE, TRUTH_FILL, LineStyle, plain, styles_of, with_unit

RECENT = 60
"""Points that are drawn with a snapshot: those of so many scans up to it."""
MARGIN = 0.08
FRAMES, FRAME_INCHES, FRAME_DPI, FRAME_MS = 72, 3.4, 72, 90


class Shape(NamedTuple):
    """A connected object over time, in the experiment's length unit."""

    segments: np.ndarray
    """(step, segment, 2 ends, 2)."""
    bodies: np.ndarray
    """(step, body, 6): x, y, semi-axes, direction (rad), whether a rectangle."""

    def reach(self) -> np.ndarray:
        """(step, point, 2): what a window should show."""
        corners = self.bodies[:, :, :2]
        around = self.bodies[:, :, 2:4].max(axis=2, keepdims=True) if corners.shape[1] else corners
        ends = self.segments.reshape(len(self.segments), -1, 2)
        return np.concatenate([ends, corners - around, corners + around], axis=1)


class Movie(NamedTuple):
    """Everything drawable of one run."""

    truth: Shape
    discs: np.ndarray
    """(disc, 3): x, y, radius."""
    filters: dict[str, Shape]
    points: np.ndarray
    """(step, point, 2); NaN where there is none."""
    window: tuple[float, float, float, float]
    """Left, right, bottom, top."""


def is_connected(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether the arrays of a run are those of a connected object."""
    return any(f"truth/{name}" in arrays for name in ("starts", "bodies", "discs"))


def movie_of(arrays: Mapping[str, np.ndarray], labels: Sequence[str], run: int) -> Movie:
    """One run of the arrays of a chunk (see `montecarlo.fields`)."""

    def shape(prefix: str, n_steps: int) -> Shape:
        named = {name: arrays.get(f"{prefix}/{name}") for name in ("starts", "ends", "bodies")}
        starts, ends, bodies = (None if a is None else np.asarray(a[run], float) for a in named.values())
        segments = np.zeros((n_steps, 0, 2, 2)) if starts is None or ends is None else np.stack([starts, ends], axis=2)
        return Shape(segments, np.zeros((n_steps, 0, 6)) if bodies is None else bodies)

    n_steps = arrays["truth/state"].shape[1]
    points, mask = np.asarray(arrays["scans/points"][run], float), np.asarray(arrays["scans/mask"][run], bool)
    truth = shape("truth", n_steps)
    discs = np.asarray(arrays["truth/discs"][run][0], float) if "truth/discs" in arrays else np.zeros((0, 3))
    seen = np.concatenate([truth.reach().reshape(-1, 2), discs[:, :2] - discs[:, 2:], discs[:, :2] + discs[:, 2:]])
    low, high = seen.min(axis=0), seen.max(axis=0)
    margin = MARGIN * float((high - low).max())
    window = (low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin)
    filters = {label: shape(f"{label}/track", n_steps) for label in labels}
    return Movie(truth, discs, filters, np.where(mask[..., None], points, np.nan), window)


def snapshot_steps(n_steps: int, count: int) -> np.ndarray:
    """Steps for so many snapshots: evenly spaced, from a little after the start to the end."""
    return np.unique(np.linspace(0, n_steps - 1, count + 1).astype(int)[1:])


def draw_snapshots(
    container: Any, movie: Movie, styles: Mapping[str, LineStyle], length_unit: str, rows: int, columns: int
) -> None:
    """Object and estimates at some steps, into a figure or a part of one."""
    panels: list[Axes] = list(np.ravel(container.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)))
    steps = snapshot_steps(len(movie.points), len(panels))
    for ax, step in zip(panels, steps, strict=False):
        draw_step(ax, movie, styles, int(step))
        ax.set_title(f"scan {step + 1}", pad=3.0)
    for ax in panels[len(steps) :]:
        ax.set_axis_off()
    for ax in panels[-columns:]:
        ax.set_xlabel(with_unit("x", length_unit))
    for ax in panels[::columns]:
        ax.set_ylabel(with_unit("y", length_unit))


def draw_step(ax: Axes, movie: Movie, styles: Mapping[str, LineStyle], step: int) -> list[Artist]:
    """True object, recent points and estimates at one step; returns what was drawn."""
    discs = [Circle((x, y), r, fc=TRUTH_FILL, ec=TRUTH_EDGE, lw=0.6, zorder=1) for x, y, r in movie.discs]
    drawn: list[Artist] = [ax.add_patch(disc) for disc in discs]
    drawn += _draw_shape(ax, movie.truth, step, TRUTH_FILL, "-", 7.0, 1)
    points = movie.points[max(step - RECENT + 1, 0) : step + 1].reshape(-1, 2)
    drawn.append(ax.scatter(points[:, 0], points[:, 1], s=5.0, color=POINT, alpha=0.6, linewidths=0.0, zorder=3))
    for label, (color, dashes) in styles.items():
        drawn += _draw_shape(ax, movie.filters[label], step, color, dashes, 1.6, 4)
    set_window(ax, movie)
    return drawn


def set_window(ax: Axes, movie: Movie) -> None:
    """The part of the plane that a movie needs."""
    left, right, bottom, top = movie.window
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)
    ax.set_aspect("equal")


def _draw_shape(ax: Axes, shape: Shape, step: int, color: str, dashes: Any, width: float, order: int) -> list[Artist]:
    lines = LineCollection(
        list(shape.segments[step]), colors=color, linestyles=[dashes], linewidths=width, capstyle="round", zorder=order
    )
    drawn: list[Artist] = [ax.add_collection(lines, autolim=False)]
    for x, y, a, b, direction, is_rectangle in shape.bodies[step]:
        look = {"fill": False, "ec": color, "ls": dashes, "lw": width, "zorder": order}
        turn = np.degrees(direction)
        if is_rectangle:
            body = Rectangle((x - a, y - b), 2 * a, 2 * b, angle=turn, rotation_point="center", **look)
        else:
            body = Ellipse((x, y), 2 * a, 2 * b, angle=turn, **look)
        drawn.append(ax.add_patch(body))
    return drawn


def connected_legend(styles: Mapping[str, LineStyle]) -> tuple[list[Artist], list[str]]:
    """Handles and names of everything drawn."""
    handles: list[Artist] = [Patch(facecolor=TRUTH_FILL, edgecolor=TRUTH_EDGE, linewidth=0.6)]
    handles.append(Line2D([], [], color=POINT, ls="none", marker=".", ms=4.0))
    handles += [Line2D([], [], color=color, ls=dashes, lw=1.6) for color, dashes in styles.values()]
    return handles, ["truth", f"points of the last {RECENT} scans", *styles]


def animation(arrays: Mapping[str, np.ndarray], labels: Sequence[str], run_index: int = 0, title: str = "") -> bytes:
    """A GIF of one run, with the first filter only; steps are denser at the start, where a filter settles.

    Args:
        arrays: tracks, scans and truth of a chunk.
        labels: filters; the first is shown.
        run_index: row of the arrays.
        title: heading of every frame, before the scan.
    """
    movie = movie_of(arrays, labels[:1], run_index)
    n_steps = len(movie.points)
    settling = min(n_steps, 5 * RECENT)
    steps = np.unique(
        np.concatenate([np.linspace(0, settling - 1, FRAMES // 4), np.linspace(0, n_steps - 1, FRAMES)]).astype(int)
    )
    styles, frames = styles_of(labels[:1]), []
    figure = Figure(figsize=(FRAME_INCHES, FRAME_INCHES), dpi=FRAME_DPI)
    ax, canvas = figure.add_axes((0.09, 0.06, 0.89, 0.87)), FigureCanvasAgg(figure)
    ax.tick_params(labelsize=7.0)
    heading = ax.set_title("", fontsize=8.0)
    set_window(ax, movie)
    canvas.draw()
    empty = canvas.copy_from_bbox(figure.bbox)  # frame and ticks are the same for all steps, and take longest
    for step in steps:
        heading.set_text(plain(f"{title}  scan {step + 1}".strip()))
        drawn = draw_step(ax, movie, styles, int(step))
        canvas.restore_region(empty)
        for artist in [*sorted(drawn, key=Artist.get_zorder), heading]:
            ax.draw_artist(artist)
        frame = Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())
        frames.append(frame.quantize(24, dither=Image.Dither.NONE))
        for artist in drawn:
            artist.remove()
    buffer = io.BytesIO()
    frames[0].save(
        buffer, "gif", save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, optimize=True, disposal=1
    )
    return buffer.getvalue()

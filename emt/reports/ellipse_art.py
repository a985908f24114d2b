"""What a trajectory figure shows, in numbers: outlines, the path, and the steps and windows worth drawing."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

N_VERTICES = 72
SPACING = 1.15
"""Distance between drawn outlines, in lengths of the object: a little more than touching."""
MOST_OUTLINES = 22
FEWEST_OUTLINES = 6
SANE_DISTANCE = 1.25
"""Outlines reaching further than this from the object, in its lengths, do not widen the drawn window."""


class Box(NamedTuple):
    """A window on the plane, in the experiment's length unit."""

    x0: float
    x1: float
    y0: float
    y1: float

    @property
    def width(self) -> float:
        """Extent along x."""
        return self.x1 - self.x0

    @property
    def height(self) -> float:
        """Extent along y."""
        return self.y1 - self.y0

    def around(self, other: "Box") -> "Box":
        """The window that shows both."""
        return Box(min(self.x0, other.x0), max(self.x1, other.x1), min(self.y0, other.y0), max(self.y1, other.y1))


class Scene(NamedTuple):
    """Everything drawable of one run, in the experiment's length unit; NaN where there is nothing to draw."""

    path: np.ndarray
    """(step, 2): true position, or the mean of the scan where there is no truth."""
    length: float
    """Typical full length of the object."""
    truth: np.ndarray | None
    """(step, vertex, 2): true outlines."""
    heading: np.ndarray | None
    """(step,): true orientation (rad)."""
    outlines: dict[str, np.ndarray]
    """(step, vertex, 2) of every filter."""
    centers: dict[str, np.ndarray]
    """(step, 2) of every filter."""
    points: np.ndarray
    """(step, max_points, 2): detections."""


def ellipse_outline(center: np.ndarray, semi_axes: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """Closed outlines (step, vertex, 2) of ellipses whose first semi-axis lies along `orientation` (rad)."""
    t = np.linspace(0.0, 2.0 * np.pi, N_VERTICES + 1)
    u, v = semi_axes[:, :1] * np.cos(t), semi_axes[:, 1:] * np.sin(t)
    c, s = np.cos(orientation)[:, None], np.sin(orientation)[:, None]
    return center[:, None, :] + np.stack([c * u - s * v, s * u + c * v], axis=-1)


def star_outline(center: np.ndarray, orientation: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Closed outlines (step, vertex, 2) of star-convex shapes.

    Args:
        center: (step, 2) area centroids, as stored with a track.
        orientation: (step,) direction of the longer axis of the equivalent ellipse (rad), as stored.
        radii: (step, angle) at equally spaced angles of the body frame.

    A track holds centroid and axes of the shape; the body frame they came from follows from the radii.
    """
    n = radii.shape[1]
    angles = np.arange(n) * (2.0 * np.pi / n)
    area = 0.5 * (radii**2).sum(axis=1)
    x, y = ((radii**3 * f(angles)).sum(axis=1) / (3.0 * area) for f in (np.cos, np.sin))
    difference = (radii**4 * np.cos(2.0 * angles)).sum(axis=1) / (4.0 * area) - (x * x - y * y)
    product = (radii**4 * np.sin(2.0 * angles)).sum(axis=1) / (4.0 * area) - 2.0 * x * y
    body = orientation - 0.5 * np.arctan2(product, difference)
    closed = np.concatenate([radii, radii[:, :1]], axis=1)
    u = closed * np.cos(np.append(angles, 0.0)) - x[:, None]
    v = closed * np.sin(np.append(angles, 0.0)) - y[:, None]
    c, s = np.cos(body)[:, None], np.sin(body)[:, None]
    return center[:, None, :] + np.stack([c * u - s * v, s * u + c * v], axis=-1)


def filter_outlines(arrays: Mapping[str, np.ndarray], label: str, run: int) -> np.ndarray:
    """Outlines (step, vertex, 2) of one filter: of its star-convex shape if it has one, or its ellipse."""
    track = {name: np.asarray(arrays[f"{label}/track/{name}"][run], float) for name in ("center", "orientation")}
    radii = arrays.get(f"{label}/track/radii")
    with np.errstate(all="ignore"):
        if radii is not None:
            return star_outline(track["center"], track["orientation"], np.asarray(radii[run], float))
        axes = np.asarray(arrays[f"{label}/track/semi_axes"][run], float)
        return ellipse_outline(track["center"], axes, track["orientation"])


def _filled(values: np.ndarray) -> np.ndarray:
    """Gaps along the first axis interpolated; zeros if there is nothing but gaps."""
    out, steps = np.zeros_like(values), np.arange(len(values))
    for column in range(values.shape[1]):
        known = np.isfinite(values[:, column])
        if known.any():
            out[:, column] = np.interp(steps, steps[known], values[known, column])
    return out


def _scan_points(arrays: Mapping[str, np.ndarray], run: int, n_steps: int) -> np.ndarray:
    if "scans/points" not in arrays:
        return np.full((n_steps, 1, 2), np.nan)
    points = np.asarray(arrays["scans/points"][run], float)
    return np.where(np.asarray(arrays["scans/mask"][run], bool)[..., None] & np.isfinite(points), points, np.nan)


def _median(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """Median of the finite values; NaN where there are none."""
    known = np.isfinite(values)
    padded = np.ma.masked_array(np.where(known, values, 0.0), ~known)
    return np.ma.filled(np.ma.median(padded, axis=axis).astype(float), np.nan)


def _fallback_length(arrays: Mapping[str, np.ndarray], labels: Sequence[str], run: int, points: np.ndarray) -> float:
    """Length of an object without truth: as the filters see it, else as wide as the scans are."""
    axes = [np.asarray(arrays[f"{label}/track/semi_axes"][run], float).max(axis=1) for label in labels]
    length = 2.0 * float(_median(np.concatenate(axes))) if axes else np.nan
    if not np.isfinite(length) or length <= 0.0:
        spread = points - _median(points, 1)[:, None, :]
        length = 4.0 * float(_median(np.abs(spread).ravel()))
    return length


def scene_of(arrays: Mapping[str, np.ndarray], labels: Sequence[str], run: int) -> Scene:
    """The scene of one run.

    Args:
        arrays: tracks and scans of a chunk, with truth or without, by name.
        labels: filters to draw.
        run: row of the arrays.
    """
    outlines = {label: filter_outlines(arrays, label, run) for label in labels}
    centers = {label: np.asarray(arrays[f"{label}/track/center"][run], float) for label in labels}
    if "truth/position" in arrays:
        path, axes, heading = (
            np.asarray(arrays[f"truth/{name}"][run], float) for name in ("position", "semi_axes", "orientation")
        )
        points, length = _scan_points(arrays, run, len(path)), 2.0 * float(np.median(axes.max(axis=1)))
        truth = ellipse_outline(path, axes, heading)
    else:
        n_steps = len(arrays["scans/points"][run]) if "scans/points" in arrays else len(next(iter(centers.values())))
        points, truth, heading = _scan_points(arrays, run, n_steps), None, None
        path = _median(points, 1)
        if not np.isfinite(path).any() and centers:
            path = _median(np.stack(list(centers.values())))
        path, length = _filled(path), _fallback_length(arrays, labels, run, points)
    if not np.isfinite(length) or length <= 0.0:
        length = max(float(np.ptp(path, axis=0).max()) / 10.0, 1.0)
    return Scene(path, length, truth, heading, outlines, centers, points)


def steps_apart(path: np.ndarray, gap: float) -> np.ndarray:
    """Steps of which each is at least `gap` from the one before: an object that waits is drawn once."""
    chosen = [0]
    for k in range(1, len(path)):
        if np.hypot(*(path[k] - path[chosen[-1]])) >= gap:
            chosen.append(k)
    return np.array(chosen)


def shown_steps(scene: Scene) -> np.ndarray:
    """Steps whose outlines are drawn: apart from each other on the path, few enough to stay readable."""
    gap, n_steps = SPACING * scene.length, len(scene.path)
    steps = steps_apart(scene.path, gap)
    while len(steps) > MOST_OUTLINES:
        gap *= 1.05
        steps = steps_apart(scene.path, gap)
    while len(steps) < min(FEWEST_OUTLINES, n_steps) and gap > 0.4 * scene.length:
        gap *= 0.8
        steps = steps_apart(scene.path, gap)
    if len(steps) == 1:
        return np.unique(np.linspace(0, n_steps - 1, min(n_steps, 3)).round().astype(int))
    return steps


def peaks(rate: np.ndarray, count: int, apart: int) -> np.ndarray:
    """Places of the largest positive entries, in order, further than `apart` from each other."""
    rate, chosen = rate.copy(), []
    while len(chosen) < count and rate.max(initial=0.0) > 0.0:
        k = int(rate.argmax())
        chosen.append(k)
        rate[max(k - apart, 0) : k + apart + 1] = 0.0
    return np.sort(np.array(chosen, int))


def zoom_steps(scene: Scene, shown: np.ndarray, count: int = 3) -> np.ndarray:
    """Middle steps of the close-ups: where the object turns fastest; spread evenly if it hardly turns.

    Args:
        scene: the scene. Without true orientation the direction of travel stands in for it.
        shown: steps drawn in the main panel.
        count: number of close-ups.
    """
    n_steps = len(scene.path)
    evenly = np.unique(np.linspace(0, n_steps - 1, count).round().astype(int))
    if n_steps < 3 or len(shown) < 5:
        return evenly
    if scene.heading is None:
        direction = np.arctan2(*np.diff(scene.path[shown], axis=0).T[::-1])
        turn = np.abs(np.angle(np.exp(1j * np.diff(direction))))
        return shown[1 + peaks(turn, count, 2)] if turn.max() > np.deg2rad(10.0) else evenly
    # an ellipse looks the same after half a turn
    turn = np.diff(scene.heading)
    turn = np.abs(turn - np.pi * np.round(turn / np.pi))
    rate = np.convolve(np.append(0.0, turn), np.bartlett(max(n_steps // 10, 1) + 2)[1:-1], mode="same")
    return peaks(rate, count, max(n_steps // 6, 1)) if rate.max() > np.deg2rad(0.5) else evenly


def neighbours(scene: Scene, k: int) -> np.ndarray:
    """Step k with the nearest step before and after it that does not overlap, if that is near enough."""
    distance = np.hypot(*(scene.path - scene.path[k]).T)
    apart = np.flatnonzero(distance >= 1.02 * scene.length)
    around = [*apart[apart < k][-1:], k, *apart[apart > k][:1]]
    return np.array([j for j in around if distance[j] <= 2.2 * scene.length])


def window(scene: Scene, steps: np.ndarray, margin: float, *, square: bool = False) -> Box:
    """The window that shows the object and all sane outlines at some steps.

    Args:
        scene: the scene.
        steps: steps whose outlines must be inside.
        margin: free border, in the experiment's length unit.
        square: whether both sides shall be equal.
    """
    half = 0.5 * scene.length
    middle = scene.path[steps]
    corners = [middle - 0.8 * half, middle + 0.8 * half]
    if scene.truth is not None:
        corners.append(scene.truth[steps].reshape(-1, 2))
    for outline in scene.outlines.values():
        vertices = outline[steps]
        reach = np.abs(vertices - middle[:, None, :]).max(axis=(1, 2))
        corners.append(vertices[reach <= SANE_DISTANCE * scene.length].reshape(-1, 2))  # NaN compares false
    every = np.concatenate(corners)
    low, high = every.min(axis=0) - margin, every.max(axis=0) + margin
    if square:
        center, side = 0.5 * (low + high), 0.5 * (high - low).max()
        low, high = center - side, center + side
    return Box(float(low[0]), float(high[0]), float(low[1]), float(high[1]))

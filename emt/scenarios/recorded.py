"""Recorded scans, read from a file of the user's."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass
from jaxtyping import Array, Bool, Float
from pydantic import Field

from emt.registry import SCENARIOS
from emt.scenarios.data import DataError, read_data
from emt.settings import Duration, Settings
from emt.types import Ellipse, Measurements, Scenario, Traced, Truth


class RecordedSettings(Settings):
    """Recorded scans without ground truth.

    Two formats, by suffix: `.mat` (MATLAB 5 to 7) with a cell array of 2 x n matrices, one cell per scan, columns
    points; `.csv` with a header and the columns `frame,x,y`, one row per point (frames without rows are empty scans).
    """

    kind: Literal["recorded"] = "recorded"
    path: str | None = None
    """The file, relative to the configuration or to the working directory."""
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None
    """Expected hash of the file; another content is refused."""
    variable: str = "Z"
    """Name of the cell array in a `.mat` file."""
    dt: Duration
    """Time between scans."""
    has_truth: ClassVar[bool] = False


@register_dataclass
@dataclass(frozen=True)
class Params:
    """The recording, as arrays."""

    dt: Traced
    points: Float[Array, "n_steps max_points 2"]
    mask: Bool[Array, "n_steps max_points"]


def read_scans(settings: RecordedSettings) -> list[np.ndarray]:
    """The points of every scan, each of shape (n, 2), in float64.

    Raises:
        DataError: the file is missing, too large, damaged, of another hash or of another layout.
    """
    path, content = read_data(settings.path, settings.sha256)
    match path.suffix.lower():
        case ".mat":
            return _scans_from_mat(path, content, settings.variable)
        case ".csv":
            return _scans_from_csv(path, content)
        case suffix:
            raise DataError(f"'{path}': unknown format '{suffix}' (known: .mat, .csv)")


def _scans_from_mat(path: Path, data: bytes, variable: str) -> list[np.ndarray]:
    from scipy.io import loadmat

    try:
        content = loadmat(io.BytesIO(data))
    except Exception as error:  # scipy raises many kinds on damaged files
        raise DataError(f"'{path}' is not a readable MATLAB file: {error}") from error
    names = [name for name in content if not name.startswith("__")]
    if variable not in names:
        raise DataError(f"'{path}' has no variable '{variable}' (it has: {', '.join(names) or 'none'})")
    cells = np.ravel(content[variable], order="F")
    if content[variable].dtype != object:
        raise DataError(f"'{path}': '{variable}' is not a cell array")
    scans = []
    for number, cell in enumerate(cells, start=1):
        array = np.asarray(cell)
        if array.dtype.kind not in "iuf" or (array.size and (array.ndim != 2 or array.shape[0] != 2)):
            raise DataError(f"'{path}': scan {number} is not a 2 x n matrix of numbers (shape {array.shape})")
        # integers may be stored unsigned: differences would wrap around
        scans.append(array.astype(np.float64).reshape(2, -1).T)
    if not scans:
        raise DataError(f"'{path}': '{variable}' holds no scan")
    return scans


def _scans_from_csv(path: Path, data: bytes) -> list[np.ndarray]:
    import pandas as pd

    try:
        table = pd.read_csv(io.BytesIO(data))
    except (ValueError, UnicodeDecodeError) as error:
        raise DataError(f"'{path}' is not a readable CSV file: {error}") from error
    missing = [c for c in ("frame", "x", "y") if c not in table.columns]
    if missing:
        raise DataError(f"'{path}' has no column {', '.join(missing)} (it has: {', '.join(map(str, table.columns))})")
    for column in ("frame", "x", "y"):
        if table[column].dtype.kind not in "iuf":
            raise DataError(f"'{path}': column '{column}' holds something that is not a number")
    frames = table["frame"].to_numpy()
    if table.empty or not np.isfinite(frames).all() or (frames != np.round(frames)).any():
        raise DataError(f"'{path}': column 'frame' must hold whole numbers")
    first, last = int(frames.min()), int(frames.max())
    if last - first > 10_000_000:
        raise DataError(f"'{path}': frames run from {first} to {last}; that is too long")
    # counted from the first frame: frame numbers themselves may be beyond the machine's integers
    numbers = (frames - frames.min()).astype(np.int64)
    points = table[["x", "y"]].to_numpy(np.float64)
    order = np.argsort(numbers, kind="stable")
    counts = np.bincount(numbers)
    return np.split(points[order], np.cumsum(counts)[:-1])


def build(settings: RecordedSettings, runs: int):
    """Static builder and the recording as traced parameters.

    Raises:
        DataError: the recording cannot be used.
    """
    scans = read_scans(settings)
    capacity = max(1, *(len(scan) for scan in scans))
    points = np.zeros((len(scans), capacity, 2))
    mask = np.zeros((len(scans), capacity), bool)
    for k, scan in enumerate(scans):
        points[k, : len(scan)], mask[k, : len(scan)] = scan, True
    n_steps = len(scans)

    def make(params: Params) -> Scenario:
        def no_truth(key) -> Truth:
            # there is none: experiments on recordings have no metric that would look at it
            zero = jnp.zeros((n_steps, 2), params.points.dtype)
            return Truth.moving(zero, zero, Ellipse(zero + 1.0, zero[:, 0]))

        def scans(truth, key):
            return Measurements(params.points, params.mask, jnp.zeros(n_steps, bool))

        return Scenario(jnp.full(n_steps, params.dt), no_truth, scans)

    return Params(settings.dt, jnp.asarray(points), jnp.asarray(mask)), make


SCENARIOS.register("recorded", RecordedSettings, build)

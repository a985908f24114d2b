"""From the chunks of a run folder to the numbers of one filter, in memory that hardly grows with the number of runs.

A median needs the values of all runs at once. So a few metrics are gathered at a time, as many as fit a fixed amount of
memory, and the chunks are read again for the next ones.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from emt.status import FAILURE, Status
from emt.store import RunReader

MAX_BLOCKS = 512
"""Blocks of runs whose sums per step are held at a time."""
MAX_SUMS = 2**19
"""Sums per step of one metric that are held at a time; very long runs are summed in fewer blocks."""
GATHERED_BYTES = 8 * 2**20
"""Memory for the values of the metrics that are gathered at a time; one metric of 1,000,000 runs takes it all."""
SLICE = 2**16
"""Values for which a temporary copy is made at a time."""
SHOWN_FAILURES = 20


class FilterResults(NamedTuple):
    """Scores of one filter in all runs without failure, and its sums per step, for some metrics."""

    values: np.ndarray
    """(metric, sound run), in order of runs."""
    step_sum: np.ndarray
    """(block, step, metric)."""
    step_count: np.ndarray
    """(block,)."""


class Total:
    """Sum of arrays of one shape with Neumaier's compensation: as if added in twice the precision."""

    def __init__(self):
        self._sum: np.ndarray | None = None
        self._lost: np.ndarray | None = None

    def add(self, values: np.ndarray) -> None:
        """One more summand."""
        if self._sum is None or self._lost is None:
            self._sum, self._lost = np.array(values, np.float64), np.zeros_like(values, np.float64)
            return
        total = self._sum + values
        larger = np.abs(self._sum) >= np.abs(values)
        self._lost += np.where(larger, (self._sum - total) + values, (values - total) + self._sum)
        self._sum = total

    def value(self) -> np.ndarray:
        """The sum so far; 0 without summands."""
        return np.zeros(()) if self._sum is None or self._lost is None else self._sum + self._lost


def sound_runs(status: np.ndarray) -> np.ndarray:
    """True for the runs without a failure bit."""
    return (status & int(FAILURE)) == 0


def column_groups(reader: RunReader, columns: list[int]) -> Iterator[list[int]]:
    """The metrics, by column, in groups that are gathered at a time."""
    runs, steps = sum(chunk.stop - chunk.start for chunk in reader.chunks()), reader.manifest["steps"]
    # sums are held twice while they are put together, and an error estimate makes two more of their size
    each = 8 * (runs + 4 * most_blocks(steps) * steps)
    size = max(1, GATHERED_BYTES // each)
    for first in range(0, len(columns), size):
        yield columns[first : first + size]


def filter_results(reader: RunReader, label: str, columns: list[int]) -> FilterResults:
    """All chunks of one filter, in run order; sums per step are merged as they come, to a bounded number of blocks.

    Args:
        columns: the metrics wanted, by their place in the manifest.
    """
    chunks = reader.chunks()
    values = np.empty((len(columns), sum(chunk.stop - chunk.start for chunk in chunks)))
    sums: list[np.ndarray] = []
    counts: list[int] = []
    found = 0
    names = {name: f"{label}/{name}" for name in ("values", "status", "step_sum", "step_count")}
    for chunk in chunks:
        arrays = reader.read_chunk(chunk, names.values())
        kept = arrays[names["values"]][sound_runs(arrays[names["status"]])]
        values[:, found : found + len(kept)] = kept[:, columns].T
        found += len(kept)
        sums += list(arrays[names["step_sum"]][..., columns])
        counts += arrays[names["step_count"]].tolist()
        while len(sums) > most_blocks(len(sums[0])):
            sums = [sum(pair[1:], pair[0]) for pair in batched(sums, 2)]
            counts = [sum(pair) for pair in batched(counts, 2)]
    return FilterResults(values[:, :found], np.stack(sums), np.array(counts))


def most_blocks(n_steps: int) -> int:
    """Blocks of runs that are kept apart when a run has so many steps."""
    return min(MAX_BLOCKS, max(MAX_SUMS // n_steps, 16))


def batched(items: list, n: int) -> list[list]:
    """Consecutive groups of `n` items; the last may be shorter."""
    return [items[k : k + n] for k in range(0, len(items), n)]


def step_totals(reader: RunReader, label: str) -> tuple[np.ndarray, np.ndarray, int]:
    """Sums and sums of squares of every metric over the runs without failure, (step, metric) each, and these runs."""
    sums, squares, runs = Total(), Total(), 0
    for chunk in reader.chunks():
        arrays = reader.read_chunk(chunk, [f"{label}/{name}" for name in ("step_sum", "step_squares", "step_count")])
        sums.add(arrays[f"{label}/step_sum"].sum(axis=0))
        squares.add(arrays[f"{label}/step_squares"])
        runs += int(arrays[f"{label}/step_count"].sum())
    return sums.value(), squares.value(), runs


def run_flags(reader: RunReader, label: str) -> dict[str, Any]:
    """What happened to a filter in how many runs, as in `summary.json`."""
    names: Counter[str] = Counter()
    failed_runs: list[int] = []
    failed = 0

    def sound_nis() -> Iterator[float]:
        nonlocal failed
        for chunk in reader.chunks():
            arrays = reader.read_chunk(chunk, [f"{label}/status", f"{label}/nis"])
            status = arrays[f"{label}/status"]
            for bits, runs in zip(*np.unique(status, return_counts=True), strict=True):
                names.update(dict.fromkeys(Status.names_of(int(bits)), int(runs)))
            sound = sound_runs(status)
            failed += int((~sound).sum())
            more = np.flatnonzero(~sound)[: SHOWN_FAILURES - len(failed_runs)]
            failed_runs.extend(chunk.start + int(run) for run in more)
            yield from arrays[f"{label}/nis"][sound].tolist()

    total = math.fsum(sound_nis())
    runs = sum(chunk.stop - chunk.start for chunk in reader.chunks())
    return {
        "failed": failed,
        "failed_runs": failed_runs,
        "runs_with": dict(sorted(names.items())),
        "mean_nis": total / (runs - failed) if runs > failed else None,
    }


def sum_of(values: np.ndarray, function: Callable[[np.ndarray], np.ndarray]) -> float:
    """Sum of a function of values, without a copy of all of them."""
    return math.fsum(float(np.sum(function(values[k : k + SLICE]))) for k in range(0, len(values), SLICE))


def mean_of(values: np.ndarray, function: Callable[[np.ndarray], np.ndarray]) -> float:
    """Mean of a function of values."""
    return sum_of(values, function) / len(values)


def variance_of(values: np.ndarray, function: Callable[[np.ndarray], np.ndarray] = np.asarray) -> float:
    """Sample variance of a function of values."""
    mean = mean_of(values, function)
    return sum_of(values, lambda some: (function(some) - mean) ** 2) / (len(values) - 1)

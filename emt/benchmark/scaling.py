"""`emt run` at growing numbers of runs, each in a process of its own: time and memory."""

import json
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from emt.benchmark.processes import WATCHED, ChildError, as_started_by_users, run_child
from emt.reports.paper import TIMING_FILE
from emt.reports.table import Column, Table

EXPERIMENT = "benchmark/vb"
RUNS = (1_000, 10_000, 100_000, 1_000_000)


def one_size(runs: int, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """`emt run` of the experiment with so many runs, into a folder that is removed afterwards.

    Returns:
        `runs`; `wall`, seconds of the whole process; `compile_seconds`; `runs_per_second` while runs were computed;
        `memory`, peak MiB.

    Raises:
        ChildError: the command failed.
    """
    with TemporaryDirectory(prefix="emt-bench-") as folder:
        out, told = Path(folder) / "results", Path(folder) / "memory"
        command = ["run", EXPERIMENT, *overrides, "--runs", str(runs), "--out", str(out)]
        started = time.perf_counter()
        run_child(
            f"emt {' '.join(command)}", [sys.executable, "-c", WATCHED, str(told), *command], as_started_by_users()
        )
        wall = time.perf_counter() - started
        try:
            timing, memory = json.loads((out / TIMING_FILE).read_text(encoding="utf-8")), float(told.read_text())
        except (OSError, ValueError) as error:
            raise ChildError(f"emt run {EXPERIMENT} left no record of its costs: {error}") from error
    return {
        "runs": runs,
        "wall": wall,
        "compile_seconds": timing["compile_seconds"],
        "runs_per_second": runs / timing["run_seconds"],
        "memory": memory,
    }


def scaling(sizes: Sequence[int], overrides: Sequence[str] = ()) -> Iterator[dict[str, Any]]:
    """See `one_size`; one after the other."""
    for runs in sizes:
        yield one_size(runs, overrides)


def scaling_table(rows: Sequence[dict[str, Any]]) -> Table:
    """For people."""
    columns = [
        Column("runs", "runs", True),
        Column("wall", "wall s", True),
        Column("compile", "compiling s", True),
        Column("rate", "runs/s", True),
        Column("memory", "peak MiB", True),
        Column("growth", "memory, of the first", True),
    ]
    shown = [
        {
            "runs": f"{row['runs']:,}",
            "wall": f"{row['wall']:.1f}",
            "compile": f"{row['compile_seconds']:.1f}",
            "rate": f"{row['runs_per_second']:,.0f}",
            "memory": f"{row['memory']:.0f}",
            "growth": f"{row['memory'] / rows[0]['memory']:.3f}",
        }
        for row in rows
    ]
    note = (
        "Each size is a process of its own, on all cores it may use; runs/s counts the time in which runs are computed."
    )
    return Table(f"scaling: emt run {EXPERIMENT}", columns, shown, rows, [note])

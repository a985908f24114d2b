"""The whole of `emt reproduce` with nothing compiled before: how long it takes, and for what."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from emt.benchmark.processes import COMMAND, ChildError, as_started_by_users
from emt.reports.paper import TIMING_FILE
from emt.reports.table import Column, Table

STAGE = re.compile(r"(?P<name>[^\s:]+): (?P<stage>compiling|running|reporting|done)\b")
"""What the command says, without a terminal, when an experiment enters a stage."""
SKIPPED = re.compile(r"(?P<name>[^\s:]+): skipped\b")


def reproduced(
    papers: Sequence[str] = (), scale: str = "paper", tell: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """Runs `emt reproduce` in a process of its own, into a folder that is removed, with an empty compilation cache.

    Args:
        papers: all by default.
        scale: "paper" or "smoke".
        tell: is given what the command says.

    Returns:
        `wall`, seconds of the whole process; `experiments`, with `compiling`, `running`, `reporting` and `wall` in
        seconds each (None where the command did not tell); `skipped`, their names.

    Raises:
        ChildError: the command failed.
    """
    with TemporaryDirectory(prefix="emt-bench-") as temporary:
        folder = Path(temporary)
        out, printed = folder / "results", folder / "printed.txt"
        command = [sys.executable, "-c", COMMAND, "reproduce", *papers, "--scale", scale, "--out", str(out)]
        environment = as_started_by_users() | {"EMT_CACHE": str(folder / "cache")}
        started = time.perf_counter()
        with (
            printed.open("w") as stdout,
            subprocess.Popen(command, env=environment, text=True, stdout=stdout, stderr=subprocess.PIPE) as child,
        ):
            assert child.stderr is not None
            said = list(heard(child.stderr, started, tell))
        wall = time.perf_counter() - started
        if child.returncode:
            raise ChildError(f"emt reproduce ended with code {child.returncode}: {said[-1][1] if said else ''}")
        experiments = [costs | timing_of(out / costs["name"]) for costs in stages(said)]
    skipped = [found["name"] for _, line in said if (found := SKIPPED.match(line))]
    return {"scale": scale, "wall": wall, "experiments": experiments, "skipped": skipped}


def heard(lines: Iterable[str], started: float, tell: Callable[[str], None]) -> Iterable[tuple[float, str]]:
    """What a process says, with the seconds since its start."""
    for line in lines:
        tell(line.rstrip())
        yield time.perf_counter() - started, line.rstrip()


def stages(said: Sequence[tuple[float, str]]) -> list[dict[str, Any]]:
    """When experiments entered their stages, as durations: `reporting`, and `wall` since the one before was done."""
    entered: dict[str, dict[str, float]] = {}
    for seconds, line in said:
        if found := STAGE.match(line):
            entered.setdefault(found["name"], {}).setdefault(found["stage"], seconds)
    costs, before = [], 0.0
    for name, times in entered.items():
        end = times.get("done", before)
        reporting = end - times["reporting"] if {"reporting", "done"} <= set(times) else None
        costs.append({"name": name, "reporting": reporting, "wall": end - before})
        before = end
    return costs


def timing_of(folder: Path) -> dict[str, Any]:
    """Seconds of compiling and running, and the number of runs, as the run folder has them."""
    try:
        found = json.loads((folder / TIMING_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = {}
    return {"compiling": found.get("compile_seconds"), "running": found.get("run_seconds"), "runs": found.get("runs")}


def reproduced_table(results: dict[str, Any]) -> Table:
    """For people."""
    parts = ("compiling", "running", "reporting", "wall")
    columns = [Column("name", "experiment"), Column("runs", "runs", True)]
    columns += [Column(part, f"{part} s", True) for part in parts]
    found = results["experiments"]
    sums = {part: sum(row[part] or 0.0 for row in found) for part in parts}
    sums["wall"] = results["wall"]

    def shown(name: str, runs: Any, row: dict[str, Any]) -> dict[str, str]:
        cells = {part: "" if row[part] is None else f"{row[part]:.1f}" for part in parts}
        return {"name": name, "runs": "" if runs is None else str(runs), **cells}

    rows = [*(shown(row["name"], row["runs"], row) for row in found), shown("in all", None, sums)]
    notes = [
        "An empty compilation cache. The wall time in all is that of the process, start and reports of papers included."
    ]
    notes += [f"Skipped, without their recordings: {', '.join(results['skipped'])}."] * bool(results["skipped"])
    return Table(f"reproduce, at {results['scale']} scale", columns, rows, [*found, {"name": "in all", **sums}], notes)

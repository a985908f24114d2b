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

DONE = re.compile(r"\[\d+/\d+, \d+ s\] (?P<name>\S+): \d+ runs in (?P<seconds>[\d.]+) s$")
"""What the command says when an experiment is done."""
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
        `wall`, seconds of the whole command; `experiments`, with `compiling`, `running`, `rest` and `wall` in seconds
        each (None where it is not known); `skipped`, their names.

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
        experiments = [timed(name, seconds, out / name) for name, seconds in done(line for _, line in said)]
    skipped = [found["name"] for _, line in said if (found := SKIPPED.match(line))]
    return {"scale": scale, "wall": wall, "experiments": experiments, "skipped": skipped}


def heard(lines: Iterable[str], started: float, tell: Callable[[str], None]) -> Iterable[tuple[float, str]]:
    """What a process says, with the seconds since its start."""
    for line in lines:
        tell(line.rstrip())
        yield time.perf_counter() - started, line.rstrip()


def done(lines: Iterable[str]) -> list[tuple[str, float]]:
    """Experiments that were done, with the seconds each took."""
    return [(found["name"], float(found["seconds"])) for line in lines if (found := DONE.match(line))]


def timed(name: str, seconds: float, folder: Path) -> dict[str, Any]:
    """What an experiment spent its seconds on, as far as its run folder tells; the rest are start, tables and
    figures."""
    try:
        found = json.loads((folder / TIMING_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = {}
    compiling, running = found.get("compile_seconds"), found.get("run_seconds")
    rest = None if compiling is None or running is None else max(seconds - compiling - running, 0.0)
    costs = {"compiling": compiling, "running": running, "rest": rest, "wall": seconds}
    return {"name": name, "runs": found.get("runs"), **costs}


def reproduced_table(results: dict[str, Any]) -> Table:
    """For people."""
    parts = ("compiling", "running", "rest", "wall")
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
        "An empty compilation cache. Experiments run side by side: their seconds add up to more than the wall time in "
        "all, which is that of the whole command."
    ]
    notes += [f"Skipped, without their recordings: {', '.join(results['skipped'])}."] * bool(results["skipped"])
    return Table(f"reproduce, at {results['scale']} scale", columns, rows, [*found, {"name": "in all", **sums}], notes)

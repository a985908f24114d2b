"""Measures workloads: what they cost, beside what others need for the same. Results are plain data."""

import platform
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from emt.benchmark.clock import Cost, interleaved
from emt.benchmark.compiling import compile_costs
from emt.benchmark.rivals import Agreement, Rival, agreement, rivals_of
from emt.benchmark.standard import WORKLOADS
from emt.benchmark.workloads import Bench, prepared

Tell = Callable[[str], None]
"""Called with a word on what is going on."""


def measure(
    name: str,
    *,
    repetitions: int,
    peers: bool = False,
    peak: float | None = None,
    overrides: Sequence[str] = (),
    compiling: bool = True,
    tell: Tell = lambda text: None,
) -> dict[str, Any]:
    """Everything about one workload.

    Args:
        peers: whether other packages take part.
        peak: additions and multiplications per second of the core; None if not known.
        overrides: texts `key=value`, to make the workload smaller.
        compiling: whether compilation is measured, in processes of its own.

    Returns:
        Plain data. Times are microseconds per run and step unless their name says otherwise, memory is in MiB.

    Raises:
        DisagreementError: a rival computes something else; nothing is timed then.
        ChildError: a process of compilation failed.
    """
    tell(f"{name}: compiling")
    bench = prepared(name, overrides)
    rivals, missing = rivals_of(bench, peers=peers)
    agreements = {}
    for rival in rivals:
        agreements[rival.name] = agreement(rival, bench)
        tell(f"{name}: {rival.name} agrees: {agreements[rival.name].text()}")
    tell(f"{name}: timing")
    costs = interleaved(bench.calls | {rival.name: rival.call for rival in rivals}, repetitions)
    own = {part: per_run_and_step(costs[part], bench.runs * bench.steps) for part in bench.calls}
    results = sizes_of(bench) | {
        "parts": own,
        "rivals": [
            compared(rival, costs[rival.name], agreements[rival.name], bench.steps, own["filter"]) for rival in rivals
        ],
        "missing": [one._asdict() for one in missing],
    }
    operations = bench.operations()
    if operations is not None:
        rate = 1e6 * operations / own["filter"]["cpu"]
        results["operations"] = operations
        results["operations_per_second"] = rate
        results["share_of_peak"] = None if peak is None else rate / peak
    if compiling:
        tell(f"{name}: compiling in processes of their own")
        with TemporaryDirectory(prefix="emt-bench-") as folder:
            results["compile"] = compile_costs(name, Path(folder), overrides)
    return results


def sizes_of(bench: Bench) -> dict[str, Any]:
    """What was timed."""
    return {
        "name": bench.name,
        "number": WORKLOADS[bench.name].number,
        "title": bench.loaded.experiment.title,
        "runs": bench.runs,
        "steps": bench.steps,
        "points_per_scan": bench.points_per_scan(),
    }


def per_run_and_step(cost: Cost, lanes: int) -> dict[str, float]:
    """Microseconds per run and step."""
    return {"cpu": 1e6 * cost.cpu / lanes, "wall": 1e6 * cost.wall / lanes, "repetitions": cost.repetitions}


def compared(rival: Rival, cost: Cost, agreed: Agreement, steps: int, own: dict[str, float]) -> dict[str, Any]:
    """A rival beside emt's filter alone; `ratio` says how many times longer it takes."""
    times = per_run_and_step(cost, rival.runs * steps)
    return {
        "name": rival.name,
        "version": rival.version,
        "runs": rival.runs,
        **times,
        "ratio": times["cpu"] / own["cpu"],
        "difference": agreed.difference,
        "standard_error": agreed.standard_error,
        "agreement": agreed.text(),
        "remark": rival.remark,
    }


def circumstances(repetitions: int, core: int | None, peak: Any) -> dict[str, Any]:
    """Machine, versions and method, for the record."""
    from emt.device import environment

    return {
        "environment": environment() | {"system": platform.platform()},
        "repetitions": repetitions,
        "core": core,
        "peak": None if peak is None else peak._asdict(),
    }

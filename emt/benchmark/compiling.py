"""What compiling a workload takes, measured in processes that do nothing else.

`python -m emt.benchmark.compiling NAME` is such a process; it prints a line of JSON.
"""

import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from emt.benchmark.processes import peak_memory, run_child


def compile_here(name: str, overrides: Sequence[str] = ()) -> dict[str, float]:
    """Compiles simulator and filter of a workload in this process and runs a chunk.

    Returns:
        `cpu` and `wall`, seconds of tracing, lowering and compiling (or reading from the cache); `memory`, peak MiB.
    """
    from emt.benchmark.workloads import load_workload
    from emt.montecarlo.chunks import Engine
    from emt.runner import build_program

    loaded = load_workload(name, overrides)
    program = build_program(loaded)
    engine = Engine(program, loaded.experiment.monte_carlo.seed, loaded.experiment.chunk_size)
    cpu, wall = time.process_time(), time.perf_counter()
    engine.compile()
    seconds = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    engine.run_chunk(0, loaded.experiment.chunk_size)
    return seconds | {"memory": peak_memory()}


def compile_costs(name: str, cache: Path, overrides: Sequence[str] = ()) -> dict[str, dict[str, float]]:
    """What `compile_here` finds in a process with an empty compilation cache, `cold`, and in the next one, `warm`.

    Args:
        cache: an empty folder.

    Raises:
        ChildError: a process failed.
    """
    command = [sys.executable, "-m", "emt.benchmark.compiling", name, *overrides]
    environment = os.environ | {"EMT_CACHE": str(cache)}
    costs = {}
    for state in ("cold", "warm"):
        printed = run_child(f"compilation of {name}", command, environment)
        costs[state] = json.loads(printed.splitlines()[-1])
    return costs


if __name__ == "__main__":
    print(json.dumps(compile_here(sys.argv[1], sys.argv[2:])))

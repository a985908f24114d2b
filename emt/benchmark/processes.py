"""Processes of their own: started, awaited, and asked for their memory."""

import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from emt.benchmark.clock import BLAS_THREADS

COMMAND = "import sys; sys.argv[0] = 'emt'; from emt.cli.main import main; main()"
"""The command `emt`, for the interpreter that runs this."""
WATCHED = """import sys
from emt.benchmark.processes import peak_memory
from emt.cli.main import main
sys.argv[0], told = "emt", sys.argv.pop(1)
try:
    main()
finally:
    with open(told, "w") as file:
        file.write(str(peak_memory()))
"""
"""The command `emt`, which writes its peak memory (MiB) into a file, its first argument."""


class ChildError(Exception):
    """A process that was to be measured failed; the text is what it said last."""


def peak_memory() -> float:
    """Largest resident memory of this process so far (MiB); NaN where the system does not tell.

    Linux's `VmHWM` is asked before `getrusage`, whose maximum a process inherits from the one that started it.
    """
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        return float(next(line.split()[1] for line in lines if line.startswith("VmHWM:"))) / 1024.0
    with suppress(ImportError):
        import resource

        unit = 2**20 if sys.platform == "darwin" else 2**10
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    return float("nan")


def as_started_by_users() -> dict[str, str]:
    """The environment without the bounds that `clock` sets for this process."""
    return {name: value for name, value in os.environ.items() if name not in BLAS_THREADS}


def run_child(name: str, command: Sequence[str], environment: Mapping[str, str] | None = None) -> str:
    """Standard output of a process, which is called `name` where it fails.

    Raises:
        ChildError: its exit code is not 0.
    """
    done = subprocess.run(command, env=environment, text=True, capture_output=True)
    if done.returncode:
        last = "\n".join(done.stderr.strip().splitlines()[-5:])
        raise ChildError(f"{name} ended with code {done.returncode}: {last}")
    return done.stdout


def help_seconds(attempts: int = 5) -> float:
    """Wall-clock seconds of `emt --help`, the process included: the least of some attempts.

    Raises:
        ChildError: it failed.
    """
    best = float("inf")
    for _ in range(attempts):
        started = time.perf_counter()
        run_child("emt --help", [sys.executable, "-c", COMMAND, "--help"], as_started_by_users())
        best = min(best, time.perf_counter() - started)
    return best

"""JAX set up once, before its first array: double precision and a compilation cache that outlives the process."""

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any


def cache_folder() -> Path | None:
    """Where compiled programs and sample sets are kept: EMT_CACHE, or the user's cache folder; None if it is `off`."""
    from platformdirs import user_cache_dir

    folder = os.environ.get("EMT_CACHE", user_cache_dir("emt"))
    return None if folder == "off" else Path(folder)


def configure() -> None:
    """Turns on double precision and the persistent compilation cache (EMT_CACHE names another folder, or `off`)."""
    import jax

    jax.config.update("jax_enable_x64", True)
    folder = cache_folder()
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


CPUINFO = Path("/proc/cpuinfo")
VECTORS = ("avx512f", "avx2", "avx", "asimd")
"""Vector instructions as Linux names them, the widest first."""


def cpu_facts() -> dict[str, str]:
    """What Linux tells of the first processor, by its own keys; nothing elsewhere."""
    try:
        lines = CPUINFO.read_text(encoding="utf-8").splitlines()
    except OSError:
        return {}
    told: dict[str, str] = {}
    for line in lines:
        key, _, value = line.partition(":")
        told.setdefault(key.strip(), value.strip())
    return told


def widest_vectors(told: dict[str, str]) -> str | None:
    """The widest of `VECTORS` that a processor has; None if it has or tells none."""
    flags = (told.get("flags") or told.get("Features") or "").split()
    return next((name for name in VECTORS if name in flags), None)


def cpu_name() -> str:
    """Model of the processor, as far as the system tells.

    Virtual machines often name a family of processors only, so its numbers and vector instructions are told as well:
    compiled programs differ between them in rounding.
    """
    told = cpu_facts()
    numbers = [f"{key.removeprefix('cpu ')} {told[key]}" for key in ("cpu family", "model") if key in told]
    widest = [name] if (name := widest_vectors(told)) else []
    return ", ".join([told.get("model name") or platform.processor() or platform.machine(), *numbers, *widest])


def processors() -> int:
    """Processors that this process may use. XLA shares its work among them, and so their number changes rounding."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """Threads among which XLA shares its work here: one per processor, unless the environment variable NPROC says."""
    told = os.environ.get("NPROC", "")
    return max(1, int(told)) if told.isdigit() else processors()


def threads_of_each(processes: int) -> dict[str, str]:
    """Environment for one of several processes that work side by side: XLA starts this process's share of threads.

    Threads for all processors in each of them would keep one another waiting: an experiment of one chunk takes two
    thirds more CPU time with two threads than with one, and as long. The threads change no result: they share the work
    of a program as it was compiled.
    """
    return {} if "NPROC" in os.environ else {"NPROC": str(max(1, processors() // processes))}


def environment() -> dict[str, Any]:
    """Versions and device, for the record of a result."""
    import jax

    packages = ("emt", "jax", "jaxlib", "numpy")
    return {
        "device": str(jax.devices()[0].device_kind),
        "backend": jax.default_backend(),
        "machine": platform.machine(),
        "cpu": cpu_name(),
        "processors": processors(),
        "python": platform.python_version(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        **{name: version(name) for name in packages},
    }

"""JAX set up once, before its first array: double precision and a compilation cache that outlives the process."""

import os
import platform
from importlib.metadata import version
from typing import Any


def configure() -> None:
    """Turns on double precision and the persistent compilation cache (EMT_CACHE names another folder, or `off`)."""
    import jax
    from platformdirs import user_cache_dir

    jax.config.update("jax_enable_x64", True)
    folder = os.environ.get("EMT_CACHE", user_cache_dir("emt"))
    if folder != "off":
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def environment() -> dict[str, Any]:
    """Versions and device, for the record of a result."""
    import jax

    packages = ("emt", "jax", "jaxlib", "numpy")
    return {
        "device": str(jax.devices()[0].device_kind),
        "backend": jax.default_backend(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        **{name: version(name) for name in packages},
    }

"""emt: batch Monte Carlo evaluation of extended-object trackers on JAX.

The public names are loaded when first used, so that `import emt` costs nothing.
"""

from importlib import import_module
from typing import Any

_PUBLIC = {
    "Estimate": "emt.types",
    "Filter": "emt.types",
    "Measurements": "emt.types",
    "Prior": "emt.types",
    "Status": "emt.status",
    "Truth": "emt.types",
    "guarded": "emt.filters.base",
    "load_experiment": "emt.config.load",
    "read_folder": "emt.store",
    "replay": "emt.runner",
    "run": "emt.runner",
}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'emt' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)

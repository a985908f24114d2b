"""Imports every metric of this package, which adds it to `METRICS` or `FAMILIES`."""

from emt.metrics import connected, iou, kinematic, likelihood, modes, projected, single_runs, soft_iou, wasserstein

__all__ = [
    "connected",
    "iou",
    "kinematic",
    "likelihood",
    "modes",
    "projected",
    "single_runs",
    "soft_iou",
    "wasserstein",
]

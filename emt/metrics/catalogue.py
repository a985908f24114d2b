"""Imports every metric of this package, which adds it to `METRICS`."""

from emt.metrics import iou, kinematic, wasserstein

__all__ = ["iou", "kinematic", "wasserstein"]

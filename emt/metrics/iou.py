"""Intersection over union of true and estimated outline."""

from emt.metrics.base import Metric, of_truth, register
from emt.shapes.ellipse import equivalent_ellipse
from emt.shapes.overlap import ellipse_iou
from emt.types import Estimate, Scalar, Truth


def iou(estimate: Estimate, truth: Truth) -> Scalar:
    """Area of the intersection over area of the union, exact for ellipses; other shapes by their equivalent ellipse."""
    offset, ellipse = equivalent_ellipse(estimate.shape)
    return ellipse_iou(
        estimate.mean[:2] + offset,
        ellipse.semi_axes,
        ellipse.orientation,
        truth.position,
        truth.ellipse.semi_axes,
        truth.ellipse.orientation,
    )


register(
    Metric(
        "iou",
        "1",
        "higher",
        "intersection over union of the true and the estimated ellipse, mean over steps",
        of_truth(iou),
        smooth="soft_iou",
    )
)

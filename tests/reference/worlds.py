"""What the filters of the benchmark's ellipses are told, as plain numbers."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class EllipseWorld(NamedTuple):
    """Model and prior of an ellipse that moves at nearly constant velocity under white acceleration."""

    dt: float
    """Time between scans, and before the first one [time]."""
    psd: float
    """Power spectral density of the acceleration on each axis [length^2/time^3]."""
    noise_cov: Array
    """Covariance of the sensor noise of a point (2, 2) [length^2]."""
    extent_scale: float
    """Covariance of the points over the object, in units of the squared semi-axes."""
    mean: Array
    cov: Array
    """Prior of x, y, vx, vy (4,), (4, 4)."""
    orientation: float
    """Prior direction of the first semi-axis [rad]."""
    semi_axes: Array
    """Prior semi-axes (2,) [length]."""
    turn_rate: float
    turn_rate_variance: float
    """Prior of the turn rate [rad/time], for filters that estimate it."""

    def motion(self) -> tuple[Array, Array]:
        """F and Q (4, 4) of a step."""
        axis = np.array([[1.0, self.dt], [0.0, 1.0]])
        noise = np.array([[self.dt**3 / 3.0, self.dt**2 / 2.0], [self.dt**2 / 2.0, self.dt]])
        return np.kron(axis, np.eye(2)), self.psd * np.kron(noise, np.eye(2))

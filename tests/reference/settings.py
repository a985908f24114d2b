"""Settings of the benchmark's experiments as the plain numbers that its filters are told.

Every filter predicts before the first scan, as in those experiments.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emt.config.experiment import Experiment
from emt.models.motion import PiecewiseAccelerationSettings, WhiteAccelerationSettings
from emt.sampling.rules import lcd_set
from tests.reference.moment_square_root import Rules, Straight, Turning
from tests.reference.particle_cloud import RangeBearingWorld
from tests.reference.worlds import EllipseWorld

Array = NDArray[np.float64]
ARM = ("length_a", "alpha_a", "length_b", "alpha_b", "alpha_c")
"""Parameters of the arm with a claw."""


def ellipse_world(experiment: Experiment) -> EllipseWorld:
    """What the filters of an ellipse are told.

    Raises:
        ValueError: the experiment starts with an update, or its process noise is another one.
    """
    model, noise = experiment.model, experiment.model.process_noise
    if experiment.start_with != "predict" or not isinstance(noise, WhiteAccelerationSettings):
        raise ValueError("the references predict before the first scan, under white acceleration")
    prior = model.prior
    return EllipseWorld(
        experiment.scenario.dt, noise.psd, np.array(model.noise_cov), model.extent_scale, np.array(prior.mean),
        np.array(prior.cov), prior.orientation, np.array(prior.semi_axes), prior.turn_rate, prior.turn_rate_variance,
    )  # fmt: skip


class MomentModes(NamedTuple):
    """Settings of interacting image-moment filters, one straight and one turning."""

    moment_cov: Array
    """Prior covariance of n11, n20, n02 (3, 3) [length^4]."""
    straight: Straight
    turning: Turning
    transition: Array
    """[i, j]: probability of mode j next, given i now."""
    rules: Rules


def moment_modes(experiment: Experiment) -> MomentModes:
    """The modes of an experiment.

    Raises:
        ValueError: they differ in more than their motion.
    """
    settings = experiment.filters["ukf_imm"]
    cv, ct = settings.modes["cv"], settings.modes["ct"]
    if ct.model_copy(update={"motion": cv.motion}) != cv or settings.likelihood != "average":
        raise ValueError("the modes must be alike but for their motion, and weighed by the average likelihood")
    noise, turn = (np.array(mode.motion.moment_noise) for mode in (cv, ct))
    return MomentModes(
        np.array(cv.moment_cov),
        Straight(noise, cv.motion.psd),
        Turning(turn, ct.motion.acceleration_variance, ct.motion.turn_acceleration_variance),
        np.array(settings.transition),
        Rules(
            np.array(experiment.model.noise_cov), cv.gamma, cv.kappa, cv.beta, cv.projection.floor,
            cv.projection.ratio, experiment.scenario.dt,
        ),
    )  # fmt: skip


class PointWorld(NamedTuple):
    """Model of a point that switches between motions at nearly constant velocity."""

    accelerations: Array
    """Known acceleration of each motion (model, 2) [length/time^2]."""
    variances: Array
    """Variance of the acceleration that is held over a step (model,) [length^2/time^4]."""
    transition: Array
    """[i, j]: probability of motion j next, given i now."""
    start: Array
    """Probabilities before the first prediction (model,)."""
    noise_cov: Array
    """Of the measured position (2, 2) [length^2]."""
    prior_cov: Array
    """Of x, y, vx, vy (4, 4)."""
    dt: float


def point_world(experiment: Experiment) -> PointWorld:
    """What the filters of a switching point are told.

    Raises:
        ValueError: the experiment starts with an update, or its process noise is another one.
    """
    model = experiment.model
    motions = list(model.named_motions.values())
    piecewise = all(isinstance(motion.noise, PiecewiseAccelerationSettings) for motion in motions)
    if experiment.start_with != "predict" or not piecewise:
        raise ValueError("the references predict before the first scan, under piecewise acceleration")
    return PointWorld(
        np.array([motion.acceleration for motion in motions]), np.array([motion.noise.variance for motion in motions]),
        np.array(model.transition_matrix), np.array(model.start_probabilities), np.array(model.measurement.noise_cov),
        np.array(model.prior.cov), experiment.scenario.dt,
    )  # fmt: skip


def range_bearing_world(experiment: Experiment) -> RangeBearingWorld:
    """What the filters of a point with measured range and bearing are told.

    Raises:
        ValueError: the experiment starts with an update, or its process noise is another one.
    """
    model, dt = experiment.model, experiment.scenario.dt
    (motion,) = model.named_motions.values()
    if experiment.start_with != "predict" or not isinstance(motion.noise, WhiteAccelerationSettings):
        raise ValueError("the references predict before the first scan, under white acceleration")
    F = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2))
    Q = motion.noise.psd * np.kron([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]], np.eye(2))
    seen, prior = model.measurement, model.prior
    return RangeBearingWorld(
        F, Q, np.array(seen.sensor), seen.range_std, seen.bearing_std, np.array(prior.mean), np.array(prior.cov)
    )


class ConnectedWorld(NamedTuple):
    """The arm with a claw."""

    mean: Array
    cov: Array
    """Prior of lengths, angles and rates (8,), (8, 8)."""
    sigma2: float
    """Variance of the sensor noise [length^2]."""
    q: Array
    """Variances that a step adds (8,)."""
    dt: float
    samples: Array
    """Of a standard normal density of state and place on a component (sample, 9)."""


def connected_world(experiment: Experiment) -> ConnectedWorld:
    """What the filter is told.

    Raises:
        ValueError: the experiment starts with an update, or the object is another one.
    """
    model, prior = experiment.model, experiment.model.prior
    if experiment.start_with != "predict" or tuple(model.shape.parameters) != ARM:
        raise ValueError("the references predict before the first scan, and know the arm with a claw only")
    mean, chosen = [], experiment.filters["weighted"].samples
    for name, kind in model.shape.parameters.items():
        mean += [prior.lengths[name]] if kind == "length" else [prior.angles[name], prior.rates.get(name, 0.0)]
    return ConnectedWorld(
        np.array(mean), np.diag(prior.variance.of(model.shape)), model.noise_cov[0][0],
        np.array(model.process_variance.of(model.shape)), experiment.scenario.dt,
        lcd_set(9, chosen.count, chosen.seed),
    )  # fmt: skip

"""PyRecEst: extended-object trackers of one ellipse, and interacting multiple models of a point."""

from importlib import import_module
from typing import Any

import jax.numpy as jnp
import numpy as np

from emt.benchmark.peers.base import ELLIPSE, POINT, Call, Peer, Scans, Steps, caller
from emt.benchmark.peers.models import Bank, Transition, prior_means, settings_of, single_measurements
from emt.config.experiment import Experiment
from emt.models.state_space.motions import ConstantVelocity


def check_backend() -> None:
    """Raises ValueError unless PyRecEst computes with NumPy, as it does by default."""
    name = import_module("pyrecest.backend").__backend_name__
    if name != "numpy":
        raise ValueError(f"PyRecEst runs on '{name}'; set PYRECEST_BACKEND=numpy")


def motion_of(experiment: Experiment) -> Transition:
    """Motion of an ellipse over one step."""
    motion = ConstantVelocity(jnp.zeros(2), experiment.model.process_noise.build())
    return Transition.of(motion, experiment.scenario.dt)


def shape_of(experiment: Experiment) -> np.ndarray:
    """Prior (orientation, semi-axis 1, semi-axis 2) in rad and m.

    Raises:
        ValueError: the prior gives the shape by its moments.
    """
    prior = experiment.model.prior
    if prior.semi_axes is None:
        raise ValueError("the prior must give the shape by its semi-axes")
    return np.array([prior.orientation, *prior.semi_axes])


def columns_of_points(scans: Scans) -> list[list[np.ndarray | None]]:
    """Points of each scan, one per column (2, n): PyRecEst would take two points in rows for the columns."""
    return [[points.T if len(points) else None for points in run] for run in scans.real()]


def ellipse_report(tracker: Any) -> tuple[float, ...]:
    """One row of the reports."""
    orientation, axis_1, axis_2 = tracker.get_point_estimate_shape()
    return (*tracker.get_point_estimate_kinematics(), abs(axis_1), abs(axis_2), orientation)


def prepare_vb(experiment: Experiment, scans: Scans) -> Call:
    """`VBRMTracker`: the same iterations in the same order, but without a floor under the inverse-gamma shapes.

    It raises ValueError where forgetting takes a shape to 1 or below; emt stops at 1.25.
    """
    check_backend()
    package = import_module("pyrecest.filters.vbrm_tracker")
    settings, model = settings_of(experiment, "vb_random_matrix"), experiment.model
    means, motion, shape = prior_means(experiment, scans), motion_of(experiment), shape_of(experiment)

    def start(run: int):
        return package.VBRMTracker(
            means[run],
            np.array(model.prior.cov),
            shape,
            settings.orientation_variance,
            inverse_gamma_shape=np.array(settings.shape),
            measurement_noise_cov=np.array(model.noise_cov),
            num_iterations=settings.iterations,
            forgetting_factor=settings.forgetting,
            extent_scale=model.extent_scale,
        )

    def predict(tracker):
        tracker.predict_linear(
            motion.matrix, sys_noise=motion.noise_cov, orientation_sys_noise=settings.orientation_noise
        )
        return tracker

    def update(tracker, points: np.ndarray):
        tracker.update(points)
        return tracker

    return caller(experiment, Steps(start, predict, update, ellipse_report), columns_of_points(scans), ELLIPSE)


def prepare_mem_ekf_star(experiment: Experiment, scans: Scans) -> Call:
    """`MEMEKFStarTracker`: the same updates, point by point in the order of the slots.

    Covariances are carried as they are, not as factors. It raises ValueError at a prediction from a semi-axis that is
    not positive; emt goes on, and reports the modulus.
    """
    check_backend()
    package = import_module("pyrecest.filters.mem_ekf_star_tracker")
    settings, model = settings_of(experiment, "mem_ekf_star"), experiment.model
    means, motion, shape = prior_means(experiment, scans), motion_of(experiment), shape_of(experiment)
    noise_cov, shape_noise = np.array(model.noise_cov), np.array(settings.shape_noise)

    def start(run: int):
        return package.MEMEKFStarTracker(
            means[run],
            np.array(model.prior.cov),
            shape,
            np.array(settings.shape_cov),
            multiplicative_noise_cov=model.extent_scale * np.eye(2),
        )

    def predict(tracker):
        tracker.predict_linear(motion.matrix, sys_noise=motion.noise_cov, shape_sys_noise=shape_noise)
        return tracker

    def update(tracker, points: np.ndarray):
        tracker.update(points, meas_noise_cov=noise_cov)
        return tracker

    return caller(experiment, Steps(start, predict, update, ellipse_report), columns_of_points(scans), ELLIPSE)


def prepare_imm(experiment: Experiment, scans: Scans) -> Call:
    """`InteractingMultipleModelFilter` of `KalmanFilter`s; known accelerations are the inputs of the motions."""
    check_backend()
    kalman = import_module("pyrecest.filters.kalman_filter")
    package = import_module("pyrecest.filters.interacting_multiple_model_filter")
    bank, means = Bank.of(experiment), prior_means(experiment, scans)
    matrices, noises = [motion.matrix for motion in bank.motions], [motion.noise_cov for motion in bank.motions]
    offsets = [motion.offset for motion in bank.motions]

    def start(run: int):
        filters = [kalman.KalmanFilter((means[run], bank.prior_cov)) for _ in bank.motions]
        return package.InteractingMultipleModelFilter(filters, bank.chain, bank.start)

    def predict(imm):
        imm.predict_linear(matrices, noises, offsets)
        return imm

    def update(imm, value: np.ndarray):
        imm.update_linear(value, bank.observed, bank.noise_cov)
        return imm

    steps = Steps(start, predict, update, lambda imm: imm.get_point_estimate())
    return caller(experiment, steps, single_measurements(scans), POINT)


PEERS = (
    Peer("pyrecest", "VBRMTracker", "vb", prepare_vb, ELLIPSE, exact=True),
    Peer("pyrecest", "MEMEKFStarTracker", "mem_ekf_star", prepare_mem_ekf_star, ELLIPSE, exact=True),
    Peer("pyrecest", "InteractingMultipleModelFilter", "multiple_model", prepare_imm, POINT, exact=True),
)

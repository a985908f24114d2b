"""Stone Soup: particle filter of a point.

It has no interacting multiple models: its `MultiModelPredictor` switches the motion of particles.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from importlib import import_module

import numpy as np

from emt.benchmark.peers.base import POINT, Call, Peer, Scans, Steps, caller
from emt.benchmark.peers.models import point_model, prior_means, settings_of, single_measurements
from emt.config.experiment import Experiment

PLACES = [0, 2, 1, 3]
"""Of x, y, vx, vy in the state (x, vx, y, vy) of the package, and the other way round."""
START = datetime(2000, 1, 1)
"""Any time will do for the prior."""


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """NumPy's global generator, from which the package draws, seeded for a while."""
    before = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(before)


def prepare_particle(experiment: Experiment, scans: Scans) -> Call:
    """`ParticlePredictor` and `ParticleUpdater` with `ESSResampler` over `SystematicResampler`.

    The updater would resample before it returns; to report the weighted particles, as emt does, the resampler is
    called at the start of the next step instead. Ranges and bearings are weighed by `CartesianToBearingRange`.

    Raises:
        ValueError: a particle filter other than the bootstrap filter, or another model.
    """
    arrays, states = import_module("stonesoup.types.array"), import_module("stonesoup.types.state")
    detections, hypotheses = import_module("stonesoup.types.detection"), import_module("stonesoup.types.hypothesis")
    motions = import_module("stonesoup.models.transition.linear")
    measurements = import_module("stonesoup.models.measurement.nonlinear")
    predictors, updaters = import_module("stonesoup.predictor.particle"), import_module("stonesoup.updater.particle")
    resamplers = import_module("stonesoup.resampler.particle")

    settings, model = settings_of(experiment, "particle"), point_model(experiment)
    motion, sensor = model.motion, model.measurement
    if settings.proposal.kind != "prior" or settings.likelihood_floor is not None:
        raise ValueError("only a bootstrap filter without likelihood_floor can be compared")
    if motion is None or motion.kind != "constant_velocity" or any(motion.acceleration):
        raise ValueError("the motion must be one of constant velocity")
    if motion.noise is None or motion.noise.kind != "white_acceleration" or sensor.kind != "range_bearing":
        raise ValueError("needs white acceleration noise and a measurement of range and bearing")

    axis, n = motions.ConstantVelocity(motion.noise.psd), settings.particles
    predictor = predictors.ParticlePredictor(motions.CombinedLinearGaussianTransitionModel([axis, axis]))
    measurement = measurements.CartesianToBearingRange(
        ndim_state=4,
        mapping=(0, 2),
        noise_covar=np.diag([sensor.bearing_std**2, sensor.range_std**2]),
        translation_offset=arrays.StateVector(sensor.sensor),
    )
    updater = updaters.ParticleUpdater(measurement)
    resampler = resamplers.ESSResampler(settings.resample_below * n, resamplers.SystematicResampler())
    means, root = prior_means(experiment, scans), np.linalg.cholesky(np.array(model.prior.cov))
    dt = timedelta(seconds=experiment.scenario.dt)
    first = START + dt * (experiment.start_with == "predict")

    def detection(value: np.ndarray | None, k: int):
        if value is None:
            return None
        return detections.Detection(arrays.StateVector(value[::-1]), timestamp=first + k * dt)

    def start(run: int):
        draws = means[run][:, None] + root @ np.random.standard_normal((len(root), n))
        particles = arrays.StateVectors(draws[PLACES])
        return states.ParticleState(particles, log_weight=np.full(n, -np.log(n)), timestamp=START)

    def predict(state):
        return predictor.predict(resampler.resample(state), timestamp=state.timestamp + dt)

    def update(state, detected):
        return updater.update(hypotheses.SingleHypothesis(state, detected))

    detected = [[detection(value, k) for k, value in enumerate(run)] for run in single_measurements(scans)]
    steps = Steps(start, predict, update, lambda state: np.asarray(state.mean, float).ravel()[PLACES])
    call = caller(experiment, steps, detected, POINT)

    def seeded_call() -> np.ndarray:
        with seeded(experiment.monte_carlo.seed):
            return call()

    return seeded_call


PEERS = (Peer("stonesoup", "ParticlePredictor, ParticleUpdater", "particle", prepare_particle, POINT, exact=False),)

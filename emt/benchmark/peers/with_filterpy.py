"""FilterPy: interacting multiple models of a point."""

from importlib import import_module

import numpy as np

from emt.benchmark.peers.base import POINT, Call, Peer, Scans, Steps, caller
from emt.benchmark.peers.models import Bank, prior_means, single_measurements
from emt.config.experiment import Experiment

TINY = 1e-100
"""Stands for probability 0 of a motion at the start: FilterPy divides by the predicted probabilities. It is far too
small to be felt, and large enough that its products with a likelihood do not vanish."""


def prepare_imm(experiment: Experiment, scans: Scans) -> Call:
    """`IMMEstimator` of `KalmanFilter`s; the known acceleration of each motion is the control input of its filter.

    `KalmanFilter` raises likelihoods below 2e-308 to that number, which matters only where every motion is more than
    thirty standard deviations off.
    """
    package = import_module("filterpy.kalman")
    bank, means, values = Bank.of(experiment), prior_means(experiment, scans), single_measurements(scans)
    if any(value is None for run in values for value in run):
        raise ValueError("FilterPy keeps the probabilities of the motions as they are when a measurement is missed")
    (m, n), push, probabilities = bank.observed.shape, np.ones(1), np.maximum(bank.start, TINY)

    def start(run: int):
        filters = []
        for motion in bank.motions:
            single = package.KalmanFilter(dim_x=n, dim_z=m, dim_u=1)
            single.x, single.P = means[run].copy(), bank.prior_cov.copy()
            single.F, single.B, single.Q = motion.matrix, motion.offset[:, None], motion.noise_cov
            single.H, single.R = bank.observed, bank.noise_cov
            filters.append(single)
        return package.IMMEstimator(filters, probabilities, bank.chain)

    def predict(imm):
        imm.predict(push)
        return imm

    def update(imm, value: np.ndarray):
        imm.update(value)
        return imm

    return caller(experiment, Steps(start, predict, update, lambda imm: imm.x), values, POINT)


PEERS = (Peer("filterpy", "IMMEstimator", "multiple_model", prepare_imm, POINT, exact=True),)

"""Kinds of golden vectors about deterministic samples and the updates that use them."""

from collections.abc import Callable, Iterator
from functools import partial
from math import pi
from typing import Any

import jax.numpy as jnp
import numpy as np

from emt.conformance.golden import Quantity, array
from emt.filters.association import Samples, evidence, updated, weighted
from emt.filters.sampling_update import conditioned, sampled_moments
from emt.linalg import Sym2, Vec2, cholesky
from emt.sampling.lcd import parts, standardised, symmetric_set
from emt.shapes.connected import ConnectedSettings, connected
from emt.shapes.linkage import Link, place, segment_residual

SPREAD = 1.06
"""A set of ours may be so much farther than another optimiser's, after standardising: there are several optima."""


def compare_lcd_samples(content: dict) -> Iterator[Quantity]:
    """Distances of the listed sets; and sets of our own: their moments, and how much farther they are than theirs."""
    for case in content["cases"]:
        shape = case["count"], case["dim"]
        given, theirs = np.reshape(np.asarray(case["reference_set"]["samples"], float), shape), case["reference_set"]
        found = parts(given)
        for name, got in zip(("D1", "D2", "D3"), found, strict=True):
            yield Quantity(f"{name} of the listed set", got, theirs["parts"][name])
        yield Quantity("distance of the listed set", found.distance, theirs["distance"], tolerance=1e-8)
        free = symmetric_set(case["dim"], case["count"])
        ours = standardised(free)
        zero, eye = np.zeros(case["dim"]), np.eye(case["dim"])
        yield Quantity("mean of our set", ours.mean(axis=0), zero, scale=1.0, tolerance=1e-12)
        yield Quantity("covariance of our set", ours.T @ ours / case["count"], eye, scale=1.0, tolerance=1e-9)
        median = case["independent_optimiser"]["objective_before_standardising"]["median"]
        excess = max(parts(free).distance / median - 1.0, 0.0)
        yield Quantity("excess of our set, before standardising", excess, 0.0, scale=1.0, tolerance=0.005)
        excess = max(parts(ours).distance / theirs["distance"] - 1.0, 0.0)
        yield Quantity("excess of our set, standardised", excess, 0.0, scale=1.0, tolerance=SPREAD - 1.0)
        if case["dim"] > 1:
            random = case["calibration"]["random_symmetric_standardised_distance"]["min"]
            excess = max(parts(ours).distance / random - 1.0, 0.0)
            yield Quantity("excess over the best of random sets", excess, 0.0, scale=1.0)


def _share(u):
    """A share uniform on (0, 1), matched in mean and variance by a standard normal."""
    return 0.5 + u / jnp.sqrt(12.0)


def _range_bearing(y):
    return lambda x, _: jnp.stack([jnp.hypot(x[0], x[1]) - y[0], jnp.arctan2(x[1], x[0]) - y[1]])


def _link(links: tuple[Link, ...], last: int, y):
    def h(x, noise):
        segment = place(links, x, Vec2(jnp.zeros(()), jnp.zeros(())))[last]
        return segment_residual(segment.length, _share(noise[0]), segment.local(Vec2.of(y))).array()

    return h


def _moving_disc(y):
    def h(x, noise):
        gap = y - x[:2]
        return jnp.stack([gap[0] ** 2 + gap[1] ** 2 - x[2] ** 2 * _share(noise[0])])

    return h


ONE = (Link(None, ((1, 1.0),), 0.0, 0),)
TWO = (Link(None, ((1, 1.0),), 0.0, 0), Link(0, ((3, 1.0),), -pi, 2))
ARM = connected(
    ConnectedSettings.model_validate(
        {
            "parameters": {
                "length_a": "length", "alpha_a": "angle", "length_b": "length", "alpha_b": "angle", "alpha_c": "angle",
            },
            "components": {
                "hub": {"kind": "disc", "radius": 0.3},
                "upper": {"kind": "segment", "length": "length_a", "angle": {"alpha_a": 1.0}},
                "lower": {
                    "kind": "segment", "after": "upper", "length": "length_b", "angle": {"alpha_b": 1.0}, "offset": -pi,
                },
                "finger_1": {"kind": "segment", "after": "lower", "length": 0.75, "angle": {"alpha_c": 0.5}},
                "finger_2": {"kind": "segment", "after": "lower", "length": 0.75, "angle": {"alpha_c": -0.5}},
            },
        }
    )
)  # fmt: skip
"""The arm of Zea et al. 2014."""
MODELS: dict[str, Callable[[Any], Callable]] = {
    "rangebearing": _range_bearing,
    "segment": partial(_link, ONE, 0),
    "chain": partial(_link, TWO, 1),
    "disc": _moving_disc,
}


def compare_s2kf_updates(content: dict) -> Iterator[Quantity]:
    """Single updates of the sampling Kalman filter, and one step of an interacting shape model."""
    for case in content["cases"]:
        kind = case["name"].rsplit("_", 1)[0]
        if kind == "ism_step":
            yield from _compare_step(case)
            continue
        if kind not in MODELS:
            raise ValueError(f"unknown model '{case['name']}' (known: {', '.join([*MODELS, 'ism_step'])})")
        x, cov, samples, y = (array(case[name]) for name in ("x", "P", "std_normal_samples", "y"))
        additive = array(case["Cy"])
        additive = additive[None] if additive.ndim == 1 else additive
        h = sampled_moments(x, cholesky(cov), samples, additive, MODELS[kind](y))
        new, expected = conditioned(x, cov, h), case["expected"]
        yield Quantity("mean of h", h.mean, expected["h_mean"])
        yield Quantity("covariance of h", h.cov, expected["h_cov"])
        yield Quantity("covariance with the state", h.cross, expected["xh_cov"])
        yield Quantity("updated state", new.mean, expected["x_updated"])
        yield Quantity("updated covariance", new.cov, expected["P_updated"])
        yield Quantity("log density of zero", new.log_density, expected["log_density_of_zero"], scale=1.0)


def _compare_step(case: dict) -> Iterator[Quantity]:
    x, cov, samples = (array(case[name]) for name in ("x", "P", "std_normal_samples"))
    move = np.eye(8)
    move[[1, 4, 6], [2, 5, 7]] = 1.0
    even = Samples(samples, jnp.full(len(samples), 1.0 / len(samples)))
    noise = array(case["sigma2"]) * Sym2.of(jnp.eye(2))
    x, cov = jnp.asarray(move) @ x, jnp.asarray(move) @ cov @ jnp.asarray(move).T + case["q"] * jnp.eye(8)
    found = evidence(x, cov, Vec2.of(array(case["y"])), noise, even, ARM)
    weights = weighted(found, jnp.full(5, -np.log(5.0)))
    mean, cov = updated(x, cov, found, weights)
    expected = case["expected"]
    yield Quantity("log likelihoods", found.log_density, expected["log_lik"])
    distances = [np.dot(h, np.linalg.solve(S, h)) for h, S in zip(expected["h_means"], expected["h_covs"], strict=True)]
    yield Quantity("squared distances", found.distance, distances)
    yield Quantity("association weights", weights, expected["weights"], scale=1.0)
    yield Quantity("state after a step", mean, expected["x"])
    yield Quantity("covariance after a step", cov, expected["P"])

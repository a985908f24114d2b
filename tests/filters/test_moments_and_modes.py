"""The image-moment filter, the random matrix with agility and their interacting models against slow arithmetic."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emt.filters.base import TrackingModel
from emt.filters.imm import ImmSettings
from emt.filters.lan_li import LanLiSettings
from emt.filters.moment_ukf import MomentUkfSettings
from emt.filters.moment_update import Projection, augmented_update, expected, point_update, projected
from emt.filters.unscented import Gaussian, Spread, square_root
from emt.linalg import Sym2, Vec2
from emt.models.motion import WhiteAcceleration
from emt.registry import FILTERS
from emt.scans import as_scan
from emt.types import Ellipse, Filter, Prior
from tests.filters.cases import FAST_COMPILE, cast
from tests.reference import lan_li as lan_li_oracle
from tests.reference import moment_ukf as moment_oracle

NOISE = np.diag([0.5, 0.3])
DT = 1.5
PROPERTIES = {"gamma": 0.9, "kappa": 0.5, "beta": 2.0}
MOMENT_COV = {"diagonal": [0.4, 0.5, 0.3]}
CV = {
    "kind": "moment_ukf",
    "motion": {"kind": "constant_velocity", "psd": 0.02, "moment_noise": {"diagonal": [0.02, 0.01, 0.03]}},
    "moment_cov": MOMENT_COV,
    "augmented": True,
    **PROPERTIES,
}
CT = {
    **CV,
    "motion": {
        "kind": "coordinated_turn",
        "moment_noise": {"diagonal": [0.02, 0.01, 0.03]},
        "acceleration_variance": 0.01,
        "turn_acceleration_variance": 1e-4,
    },
}
SLOW = {"kind": "lan_li", "degrees_of_freedom": 12.0, "psd": 0.02, "agility": 30.0, "rotation": 0.0}
FAST = {"kind": "lan_li", "degrees_of_freedom": 12.0, "psd": 0.2, "agility": 8.0, "rotation": 0.2}
TRANSITION = [[0.95, 0.05], [0.2, 0.8]]


def built(settings) -> Filter:
    params, make = FILTERS.get(settings.kind).builder(settings)
    model = TrackingModel(WhiteAcceleration(0.02), Sym2.of(NOISE), 0.25)
    return make(cast(params, np.float64), cast(model, np.float64))


def prior() -> Prior:
    ellipse = Ellipse(jnp.array([5.0, 3.0]), jnp.asarray(0.4))
    cov = jnp.diag(jnp.array([1.0, 1.5, 0.2, 0.3]))
    return Prior(jnp.array([0.3, -0.2, 2.0, 1.0]), cov, ellipse, jnp.asarray(0.05), jnp.asarray(1e-3))


def scans() -> list[np.ndarray]:
    """Points about an object that turns; an empty scan and one with a single point among them."""
    rng = np.random.default_rng(8)
    found = []
    for k, n in enumerate([4, 6, 0, 1, 5, 7]):
        center = np.array([2.0, 1.0]) * DT * (k + 1)
        found.append(center + rng.normal(size=(n, 2)) * [2.4, 1.4] + rng.normal(size=(n, 2)) @ np.sqrt(NOISE))
    return found


def tracked(flt: Filter):
    """States after every scan, with a prediction before each that is not empty of points, and the diagnostics."""
    key = jax.random.key(0)

    @jax.jit
    def step(state, scan):
        predicted = flt.predict(state, jnp.asarray(DT), key)
        new, info = flt.update(predicted, scan, key)
        new = jax.tree.map(lambda a, b: jnp.where(scan.mask.any(), a, b), new, predicted)
        return new, info, flt.estimate(new)

    state = flt.init(prior(), key)
    first = as_scan(jnp.asarray(scans()[0]), 7)
    step = step.lower(state, first).compile(compiler_options=FAST_COMPILE)
    rows = []
    for points in scans():
        state, info, estimate = step(state, as_scan(jnp.asarray(points), 7))
        rows.append((state, info, estimate))
    return rows


def start_of_moments(n: int):
    N = np.asarray(0.25 * Sym2.ellipse(5.0, 3.0, 0.4).array())
    mean = np.array([N[0, 1], N[0, 0], N[1, 1], 0.3, 2.0, -0.2, 1.0, 0.05])[:n]
    return mean, np.diag([0.4, 0.5, 0.3, 1.0, 0.2, 1.5, 0.3, 1e-3][:n])


def predicted_moments(mean, cov):
    if len(mean) == 7:
        return moment_oracle.predict_straight(mean, cov, np.diag([0.02, 0.01, 0.03]), 0.02, DT)
    noise = np.diag([0.02, 0.01, 0.03, 0.01, 0.01, 1e-4])
    return moment_oracle.predict_turn(mean, cov, noise, DT, **PROPERTIES)


def updated_moments(mean, cov, points):
    """State after a scan and the sum of the log-likelihoods under the prediction."""
    terms = [moment_oracle.update(mean, cov, z, NOISE, **PROPERTIES)[2:] for z in points]
    for z in points:
        mean, cov, *_ = moment_oracle.update(mean, cov, z, NOISE, **PROPERTIES)
    return mean, cov, sum(-0.5 * (phi**2 / S + np.log(2.0 * np.pi * S)) for phi, S in terms)


@pytest.mark.parametrize(("settings", "n"), [(CV, 7), (CT, 8)], ids=["straight", "turning"])
def test_augmented_moment_filter_equals_its_oracle(settings, n):
    mean, cov = start_of_moments(n)
    for (state, info, _), points in zip(
        tracked(built(MomentUkfSettings.model_validate(settings))), scans(), strict=True
    ):
        mean, cov, total = updated_moments(*predicted_moments(mean, cov), points)
        np.testing.assert_allclose(state.mean, mean, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(state.cov(), cov, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(info.log_likelihood, total, rtol=1e-7)


def test_collapsed_update_equals_augmented_update():
    rng = np.random.default_rng(3)
    bound = jax.jit(lambda b, z, s: (point_update(b, z, R, s, None), augmented_update(b, z, R, s, None)))
    R = Sym2(0.5, 0.2, 0.4)
    for kappa, beta in [(0.5, 2.0), (-6.0, 2.0), (0.0, 0.81), (2.0, 1.0)]:
        factor = 0.2 * rng.normal(size=(8, 8))
        mean = jnp.array([0.5, 6.0, 4.0, 1.0, 2.0, -1.0, 1.0, 0.1])
        belief = Gaussian(mean, jnp.linalg.cholesky(jnp.asarray(factor @ factor.T + 0.02 * np.eye(8))))
        spread = Spread(*(jnp.asarray(x) for x in (0.9, kappa, beta)))
        ours, printed = bound(belief, Vec2(jnp.asarray(3.0), jnp.asarray(2.0)), spread)
        np.testing.assert_allclose(ours.mean, printed.mean, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(ours.cov(), printed.cov(), rtol=1e-12, atol=1e-13)


def test_projection_keeps_a_wide_prior_sound():
    mean, cov = start_of_moments(8)
    belief = Gaussian(jnp.asarray(mean), square_root(jnp.asarray(cov).at[:3, :3].multiply(1e4)))
    bounds, spread = (
        Projection(jnp.asarray(0.1), jnp.asarray(0.05)),
        Spread(jnp.asarray(1.0), jnp.asarray(-6.0), jnp.asarray(2.0)),
    )
    for point in [(30.0, 1.0), (-40.0, 0.0), (0.0, 0.0)]:
        z = Vec2(jnp.asarray(point[0]), jnp.asarray(point[1]))
        now = expected(belief, z, Sym2.of(NOISE), spread, bounds)
        assert now.variance > (now.cross**2).sum() + 1.0 / 12.0 - 1e-12
        belief, _ = projected(point_update(belief, z, Sym2.of(NOISE), spread, bounds), bounds)
        n11, n20, n02 = belief.mean[:3]
        values = np.linalg.eigvalsh(np.array([[n20, n11], [n11, n02]]))
        assert values[1] >= 0.1 * (1 - 1e-9)
        assert values[0] >= 0.05 * values[1] * (1 - 1e-9)


def start_of_matrix():
    X = np.asarray(Sym2.ellipse(5.0, 3.0, 0.4).array())
    P = np.diag([1.25, 0.25]) / 15.0
    return np.array([0.3, -0.2, 2.0, 1.0]), P, 12.0, 6.0 * X


def assert_matrix(state, expected_state):
    x, P, nu, V = expected_state
    ours = np.array([state.position.x, state.position.y, state.velocity.x, state.velocity.y])
    np.testing.assert_allclose(ours, x, rtol=1e-9)
    np.testing.assert_allclose(state.kinematic.array(), P, rtol=1e-9)
    np.testing.assert_allclose(state.freedom, nu - 6.0, rtol=1e-9)
    np.testing.assert_allclose(state.extent.array(), V / (nu - 6.0), rtol=1e-9)


def test_random_matrix_equals_its_oracle():
    state = start_of_matrix()
    for (ours, info, _), points in zip(tracked(built(LanLiSettings.model_validate(FAST))), scans(), strict=True):
        state = lan_li_oracle.predict(*state, DT, 0.2, 8.0, 0.2)
        state, total = lan_li_oracle.update(*state, points, NOISE, 0.25)
        assert_matrix(ours, state)
        np.testing.assert_allclose(info.log_likelihood, total, rtol=1e-9)


def mixing(mu):
    """Weights (from, to) and predicted probabilities, in plain probabilities."""
    joint = mu[:, None] * np.array(TRANSITION)
    return joint / joint.sum(axis=0), joint.sum(axis=0)


def test_imm_of_random_matrices_equals_its_oracle():
    settings = ImmSettings.model_validate(
        {"kind": "imm", "modes": {"slow": SLOW, "fast": FAST}, "transition": TRANSITION, "start": [0.6, 0.4]}
    )
    states, mu = [start_of_matrix()] * 2, np.array([0.6, 0.4])
    moves = [(DT, 0.02, 30.0, 0.0), (DT, 0.2, 8.0, 0.2)]
    for (ours, _, estimate), points in zip(tracked(built(settings)), scans(), strict=True):
        weights, mu = mixing(mu)
        mixed = [lan_li_oracle.merge(weights[:, j], states) for j in range(2)]
        results = [
            lan_li_oracle.update(*lan_li_oracle.predict(*s, *move), points, NOISE, 0.25)
            for s, move in zip(mixed, moves, strict=True)
        ]
        states = [state for state, _ in results]
        mu = mu * np.exp([total for _, total in results])
        mu = mu / mu.sum()
        for mode, state in zip(ours.modes, states, strict=True):
            assert_matrix(mode, state)
        np.testing.assert_allclose([estimate.modes["slow"], estimate.modes["fast"]], mu, rtol=1e-8)
        np.testing.assert_allclose(estimate.mean, lan_li_oracle.merge(mu, states)[0], rtol=1e-9)


def test_imm_of_moment_filters_equals_its_oracle():
    modes = {"cv": CV, "ct": CT}
    settings = ImmSettings.model_validate(
        {"kind": "imm", "modes": modes, "transition": TRANSITION, "likelihood": "average"}
    )
    states, mu = [start_of_moments(7), start_of_moments(8)], np.array([0.5, 0.5])
    for (ours, _, estimate), points in zip(tracked(built(settings)), scans(), strict=True):
        weights, mu = mixing(mu)
        means, covs = zip(*states, strict=True)
        mixed = [moment_oracle.merge(weights[:, j], means, covs, 7 + j) for j in range(2)]
        results = [updated_moments(*predicted_moments(*state), points) for state in mixed]
        states = [(mean, cov) for mean, cov, _ in results]
        mu = mu * np.exp([total / max(len(points), 1) for *_, total in results])
        mu = mu / mu.sum()
        for mode, (mean, cov) in zip(ours.modes, states, strict=True):
            np.testing.assert_allclose(mode.mean, mean, rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(mode.cov(), cov, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose([estimate.modes["cv"], estimate.modes["ct"]], mu, rtol=1e-6)
        merged = moment_oracle.merge(mu, *zip(*states, strict=True), 7)[0]
        np.testing.assert_allclose(estimate.mean, merged[[3, 5, 4, 6]], rtol=1e-6)

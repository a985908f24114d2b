"""Particle filters of points, and resampling, against plain NumPy with the same random numbers."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import quad

from emt.draws import normals
from emt.filters.particle import ParticleState, moments
from emt.filters.resampling import effective_fraction, systematic
from emt.models.motion import WhiteAcceleration
from emt.models.state_space.measurements import Position
from emt.models.state_space.motions import ConstantVelocity, Growth
from emt.status import FAILURE, Status
from tests.filters.point_cases import (
    QUICK,
    TIGHT,
    World,
    assert_close,
    bearing_worlds,
    growth_worlds,
    one_motion,
    simulated,
    textbook,
    tracked,
)
from tests.reference import kalman, particle, unscented

N = 32
"""Particles, and weights to resample by: a power of two, so that the arithmetic of dyadic weights is exact."""
resample = jax.jit(partial(systematic, known=jnp.asarray(1.0)), compiler_options=QUICK)


def dyadic(cuts: list[int]) -> np.ndarray:
    """N weights in 1/1024, many of them zero, from the places where the unit interval is cut."""
    return np.diff([0, *sorted(cuts), 1024]) / 1024.0


CUTS = st.lists(st.integers(0, 1024) | st.sampled_from([0, 512, 1024]), min_size=N - 1, max_size=N - 1)


@given(CUTS, st.integers(0, 63))
def test_systematic_resampling_is_that_of_the_textbook(cuts, u):
    """Exactly, also where a position falls on the border between two particles."""
    weights = dyadic(cuts)
    found = np.asarray(resample(jnp.asarray(weights), jnp.asarray(u / 64.0)))
    np.testing.assert_array_equal(found, particle.systematic_resample(weights, u / 64.0))


@pytest.mark.parametrize("place", [0, 7, N - 1])
@pytest.mark.parametrize("u", [0.0, 0.5, 1.0 - 2.0**-40])
def test_a_single_particle_with_weight_takes_all_places(place, u):
    weights = np.eye(N)[place]
    np.testing.assert_array_equal(resample(jnp.asarray(weights), jnp.asarray(u)), np.full(N, place))


@given(st.integers(0, 10_000), st.floats(0.05, 20.0), st.integers(0, N - 1))
def test_counts_of_descendants_are_those_expected_to_within_one(seed, shape, zeros):
    rng = np.random.default_rng(seed)
    weights = rng.gamma(shape, size=N)
    weights[rng.permutation(N)[:zeros]] = 0.0
    weights, u = weights / weights.sum(), rng.uniform()
    found = np.asarray(resample(jnp.asarray(weights), jnp.asarray(u)))
    np.testing.assert_array_equal(found, particle.systematic_resample(weights, u))
    assert (np.diff(found) >= 0).all()
    counts = np.bincount(found, minlength=N)
    assert (np.abs(counts - N * weights) < 1.0 + 1e-9).all()
    assert (counts[weights == 0.0] == 0).all()


@given(st.integers(0, 10_000), st.floats(0.05, 20.0))
def test_effective_fraction_of_weights(seed, shape):
    weights = np.random.default_rng(seed).gamma(shape, size=N)
    weights = weights / weights.sum()
    found = float(effective_fraction(jnp.asarray(weights)))
    assert found == pytest.approx(particle.effective_samples(weights) / N, rel=1e-12)
    assert 1.0 / N * (1.0 - 1e-12) <= found <= 1.0 + 1e-12


def test_effective_fraction_is_one_of_even_weights_and_least_of_one():
    assert float(effective_fraction(jnp.full(N, 1.0 / N))) == pytest.approx(1.0)
    assert float(effective_fraction(jnp.asarray(np.eye(N)[3]))) == 1.0 / N


# whole steps, with the random numbers of the filter


def draws_of(world: World, k: int, shape: tuple[int, int]):
    """(uniform, normals of the motion, normals of the proposal) of a step."""
    predict_key, update_key = jax.random.split(jax.random.fold_in(world.key, k))
    u_key, noise_key = jax.random.split(predict_key)
    gaussian = [np.asarray(normals(key, shape[::-1], jnp.float64)).T for key in (noise_key, update_key)]
    return float(jax.random.uniform(u_key)), *gaussian


def start_of(world: World) -> np.ndarray:
    """Particles drawn from the prior."""
    n = len(world.prior.mean)
    draws = np.asarray(normals(world.key, (n, N), jnp.float64)).T
    return np.asarray(world.prior.mean) + draws @ np.linalg.cholesky(np.asarray(world.prior.cov)).T


def log_likelihood(s, z, x) -> float:
    return kalman.log_gaussian(kalman.wrapped(z - s.h(x), s.angles), s.R)


def bootstrap(world: World, fraction: float):
    """Results of every step, and which of them were resampled."""
    particles, log_weights, results = start_of(world), np.full(N, -np.log(N)), []
    for k, s in enumerate(textbook(world)):
        u, noise, _ = draws_of(world, k, particles.shape)
        z, root = np.asarray(world.scans.points[k, 0]), np.linalg.cholesky(s.Q)
        seen = bool(world.scans.mask[k, 0])
        result = particle.bootstrap_step(
            particles, log_weights, z, u, noise, lambda x, v, s=s, root=root: s.f(x) + root @ v,
            (lambda z, x, s=s: log_likelihood(s, z, x)) if seen else (lambda z, x: 0.0), fraction,
        )  # fmt: skip
        particles, log_weights = result.particles, result.log_weights
        results.append(result)
    return results


def assert_particles(answer, results) -> None:
    """Particles, weights, and the estimate from them, step by step."""
    for k, result in enumerate(results):
        assert_close(answer.state.particles[k].T, result.particles)
        assert_close(answer.state.weights[k], np.exp(result.log_weights))
        assert_close(answer.estimate.mean[k], result.mean)
        # the textbook's Σ w x xᵀ - m mᵀ has lost digits to the distance from the origin
        np.testing.assert_allclose(answer.estimate.cov[k], result.cov, rtol=TIGHT, atol=1e-12 * (result.mean**2).max())
    np.testing.assert_array_equal(answer.estimate.cov, np.swapaxes(answer.estimate.cov, 1, 2))
    assert not (answer.info.status & int(FAILURE)).any()


@pytest.mark.parametrize("fraction", [0.5, 1.0])
def test_bootstrap_steps_are_those_of_the_textbook(fraction):
    """Some steps are resampled and some are not; empty scans move the particles and leave the weights."""
    world = bearing_worlds()[1]
    answer = tracked({"kind": "particle", "particles": N, "resample_below": fraction}, world)
    results = bootstrap(world, fraction)
    assert_particles(answer, results)
    kept = [np.array_equal(result.ancestors, np.arange(N)) for result in results]
    assert not all(kept)
    assert any(kept)  # with 1.0, after the empty scans and at the start
    effective = [particle.effective_samples(np.exp(result.log_weights)) / N for result in results]
    assert_close(answer.info.effective_samples, np.array(effective))


PROPOSALS = {
    "ekf": {"kind": "ekf"},
    "ekf, restart": {"kind": "ekf", "restart": True},
    "ukf": {"kind": "ukf", "alpha": 0.8, "beta": 1.5, "kappa": 0.5},
    "ukf, restart": {"kind": "ukf", "alpha": 0.8, "beta": 1.5, "kappa": 0.5, "restart": True},
    "ukf, augmented": {"kind": "ukf", "alpha": 0.8, "beta": 1.5, "kappa": 0.5, "points": "augmented"},
}


def proposed(label: str, s, Q, R, x, P, z):
    """Mean and covariance of the proposal of one particle."""
    scaling = unscented.Scaling(0.8, 1.5, 0.5)
    match label.split(", "):
        case ["ekf"]:
            x, P = kalman.extended_predict(x, P, s.f, s.jacobian_f, Q)
            found = kalman.extended_update(x, P, z, s.h, s.jacobian_h, R, s.angles)
        case ["ekf", "restart"]:
            found = kalman.extended_update(s.f(x), Q, z, s.h, s.jacobian_h, R, s.angles)
        case ["ukf", "restart"]:
            found = unscented.update(s.f(x), Q, z, s.h, R, scaling, s.angles)
        case ["ukf", "augmented"]:
            f = lambda x, v: s.f(x) + v  # noqa: E731
            found = unscented.augmented_step(x, P, z, f, Q, s.h, R, scaling, s.angles)
        case ["ukf"]:
            found = unscented.redrawn_step(x, P, z, s.f, Q, s.h, R, scaling, s.angles)
    return found[:2]


@pytest.mark.parametrize("label", PROPOSALS)
def test_steps_with_a_gaussian_proposal_are_those_of_the_textbook(label):
    """All scans hold something; proposals of the first filters believe in noises of their own."""
    full = bearing_worlds(turning=True)[2]
    mean, cov = np.asarray(full.prior.mean), np.asarray(full.prior.cov)
    world = simulated(np.random.default_rng(8), full.model, mean, 0.1 * cov, np.asarray(full.dt)[:6], gaps=False)
    world = world._replace(prior=full.prior)
    own = {} if ", " in label else {"process_noise": np.diag([0.3, 0.3, 0.4, 0.4]).tolist(), "noise_cov": [0.3, 0.004]}
    settings = {"kind": "particle", "particles": N, "resample_below": 0.7, "proposal": PROPOSALS[label] | own}
    answer = tracked(settings, world)
    particles, covs = start_of(world), np.broadcast_to(np.asarray(world.prior.cov), (N, 4, 4))
    log_weights, results = np.full(N, -np.log(N)), []
    for k, s in enumerate(textbook(world)):
        u, _, noise = draws_of(world, k, particles.shape)
        Q, R = (np.diag([0.3, 0.3, 0.4, 0.4]), np.diag([0.3, 0.004])) if own else (s.Q, s.R)
        result = particle.proposal_step(
            particles, covs, log_weights, np.asarray(world.scans.points[k, 0]), u, noise,
            partial(proposed, label, s, Q, R), lambda x, before, s=s: kalman.log_gaussian(x - s.f(before), s.Q),
            lambda z, x, s=s: log_likelihood(s, z, x), 0.7,
        )  # fmt: skip
        particles, covs, log_weights = result.particles, result.covariances, result.log_weights
        results.append(result)
    assert_particles(answer, results)
    assert_close(answer.state.own.covs[-1], covs)
    resampled = [not np.array_equal(result.ancestors, np.arange(N)) for result in results]
    assert any(resampled[1:])
    assert not all(resampled)


def test_a_first_scan_without_a_prediction_weighs_draws_of_the_prior():
    """There is no motion yet that a proposal could be weighed against."""
    world = bearing_worlds()[0]
    s, z = textbook(world)[0], np.asarray(world.scans.points[0, 0])
    expected = particle.normalised(np.array([log_likelihood(s, z, x) for x in start_of(world)]))
    answer = tracked({"kind": "particle", "particles": N, "proposal": {"kind": "ekf"}}, world, first=False)
    assert_close(answer.state.particles[0].T, start_of(world))
    assert_close(answer.state.weights[0], np.exp(expected))
    np.testing.assert_array_equal(answer.state.own.covs[0], np.broadcast_to(world.prior.cov, (N, 4, 4)))


def test_the_growth_series_is_weighed_by_its_gamma_noise():
    """Proposals that fall behind the motion get no weight at all; the rest is that of the textbook."""
    world = growth_worlds(gaps=False)[0]
    settings = {"kind": "ekf", "process_noise": [[7.5]], "noise_cov": [[0.1]]}
    answer = tracked({"kind": "particle", "particles": N, "resample_below": 1.0, "proposal": settings}, world)
    particles, covs, log_weights, none = start_of(world), np.full((N, 1, 1), 0.75), np.full(N, -np.log(N)), 0
    with np.errstate(divide="ignore"):
        for k, s in enumerate(textbook(world)[:10]):
            u, _, noise = draws_of(world, k, particles.shape)
            result = particle.proposal_step(
                particles, covs, log_weights, np.asarray(world.scans.points[k, 0]), u, noise,
                partial(proposed, "ekf", s, np.array([[7.5]]), np.array([[0.1]])),
                lambda x, before, s=s: stats.gamma(3, scale=0.5).logpdf((x - s.f(before))[0]),
                lambda z, x, s=s: log_likelihood(s, z, x), 1.0,
            )  # fmt: skip
            particles, covs, log_weights = result.particles, result.covariances, result.log_weights
            assert_close(answer.state.particles[k].T, particles)
            assert_close(answer.state.weights[k], np.exp(log_weights))
            none += (log_weights == -np.inf).sum()
    assert none > 0


# what particles approach, and where they end


def linear_world(noise: float = 4.0, spread: float = 9.0) -> World:
    """Constant velocity, four measurements."""
    motion = ConstantVelocity(jnp.zeros(2), WhiteAcceleration(jnp.asarray(0.5)))
    model = one_motion(motion, Position(noise * jnp.eye(2)))
    cov = np.diag([spread, spread, 1.0, 1.0])
    return simulated(np.random.default_rng(1), model, np.zeros(4), cov, np.ones(4), gaps=False)


@pytest.mark.parametrize("proposal", [None, {"kind": "ekf", "restart": True}], ids=["bootstrap", "ekf"])
def test_many_particles_approach_the_kalman_filter(proposal):
    """Mean and covariance; the error is a few times the deviation over the root of their number."""
    world, count = linear_world(), 20_000
    exact = tracked({"kind": "kalman"}, world)
    settings = {"kind": "particle", "particles": count} | ({} if proposal is None else {"proposal": proposal})
    found = tracked(settings, world)
    scale = np.sqrt(np.diagonal(exact.estimate.cov, axis1=1, axis2=2))
    bound = 8.0 / np.sqrt(count)
    assert (np.abs(found.estimate.mean - exact.estimate.mean) < bound * scale).all()
    gaps = np.abs(found.estimate.cov - exact.estimate.cov) / (scale[:, :, None] * scale[:, None, :])
    assert gaps.max() < bound
    assert np.abs(found.info.log_likelihood - exact.info.log_likelihood).max() < bound
    assert np.abs(found.info.nis - exact.info.nis).max() < 5.0 * bound


def test_a_proposal_that_knows_the_measurement_keeps_more_particles():
    """Where the measurement is much more precise than the prediction."""
    world = linear_world(1e-2, 0.1)
    settings = {"kind": "particle", "particles": 20_000}
    plain = tracked(settings, world).info.effective_samples
    guided = tracked({**settings, "proposal": {"kind": "ekf", "restart": True}}, world).info.effective_samples
    assert guided.mean() > 3.0 * plain.mean()


def spoiled(world: World, k: int, value) -> World:
    """The world with one measurement far away."""
    return world._replace(scans=world.scans._replace(points=world.scans.points.at[k, 0].set(jnp.asarray(value))))


@pytest.mark.parametrize("proposal", [None, {"kind": "ekf"}], ids=["bootstrap", "ekf"])
def test_likelihoods_that_all_underflow_leave_the_state_sound(proposal):
    """An outlier of 1e5 deviations: weights in logarithms still tell the nearest particle, and the step is flagged."""
    settings = {"kind": "particle", "particles": N} | ({} if proposal is None else {"proposal": proposal})
    answer = tracked(settings, spoiled(linear_world(), 1, [1e5, -1e5]))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((answer.estimate, answer.info)))
    assert_close(answer.state.weights.sum(axis=1), np.ones(4), 1e-12)
    assert answer.info.status[1] & Status.GROSS_INNOVATION
    assert not (answer.info.status & int(FAILURE)).any()
    assert answer.info.log_likelihood[1] < -1e6


def test_weights_that_all_vanish_stay_as_they_were():
    """No proposal of the growth series lies ahead of the motion, so that none can be; the state goes on."""
    world = growth_worlds(gaps=False)[0]
    settings = {"kind": "ekf", "process_noise": [[1e-6]], "noise_cov": [[1e-6]], "restart": True}
    far = spoiled(world, 9, [-1e3])  # after the change, where the measurement tells the sign
    answer = tracked({"kind": "particle", "particles": N, "resample_below": 1.0, "proposal": settings}, far)
    np.testing.assert_array_equal(answer.state.weights[9], np.full(N, 1.0 / N))
    assert answer.info.status[9] & Status.GROSS_INNOVATION
    assert (answer.state.weights[8] != 1.0 / N).any()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((answer.estimate, answer.info, answer.state)))
    assert_close(answer.state.weights.sum(axis=1), np.ones(len(world.dt)), 1e-12)
    assert not (answer.info.status & int(FAILURE)).any()


def test_a_floor_of_the_likelihood_leaves_weights_alike_where_nothing_fits():
    settings = {"kind": "particle", "particles": N, "resample_below": 1.0}
    far = spoiled(linear_world(), 1, [1e5, -1e5])
    floored = tracked({**settings, "likelihood_floor": 1e-99}, far)
    assert_close(floored.state.weights[1], np.full(N, 1.0 / N), 1e-12)
    assert float(floored.info.effective_samples[1]) == pytest.approx(1.0)
    assert tracked(settings, far).info.effective_samples[1] < 0.1
    near = tracked({**settings, "likelihood_floor": 1e-99}, linear_world())
    assert_close(near.state.weights, tracked(settings, linear_world()).state.weights, 1e-12)


def test_a_cloud_of_one_particle_reports_a_positive_covariance():
    """All weight on one particle: a millionth of the deviation of a step is left."""
    rng = np.random.default_rng(0)
    state = ParticleState(
        jnp.asarray(rng.normal(size=(4, N))), jnp.asarray(np.eye(N)[5]), jnp.asarray(0.0), jnp.full(4, 1e-12), None
    )
    belief = moments(state)
    np.testing.assert_array_equal(belief.mean, state.particles[:, 5])
    np.testing.assert_array_equal(belief.cov, 1e-12 * np.eye(4))
    sharp = one_motion(linear_world().model.motions[0], Position(1e-8 * jnp.eye(2)))
    answer = tracked({"kind": "particle", "particles": N, "resample_below": 0.0}, linear_world()._replace(model=sharp))
    assert answer.info.effective_samples[-1] == pytest.approx(1.0 / N)
    assert (np.linalg.eigvalsh(answer.estimate.cov) > 0.0).all()
    assert not (answer.info.status & int(FAILURE)).any()


def test_particles_that_restart_do_not_depend_on_what_they_carried():
    """Another prior covariance with the same draws is forgotten after the first step; without restart it is not."""
    world = linear_world()
    for proposal, same in (({"kind": "ekf", "restart": True}, True), ({"kind": "ekf"}, False)):
        answer = tracked({"kind": "particle", "particles": N, "proposal": proposal}, world)
        spread = np.ptp(answer.state.own.covs, axis=1).max()
        changes = np.abs(np.diff(answer.state.own.covs[:, 0], axis=0)).max()
        assert spread < 1e-12  # the model is linear: all particles have the same covariance
        assert (changes < 1e-12) == same


# gamma noise


@pytest.mark.parametrize(("shape", "rate"), [(1, 0.7), (3, 2.0)])
def test_gamma_noise_has_the_stated_moments_and_density(shape, rate):
    motion = Growth(jnp.asarray(0.1), jnp.asarray(rate), shape)
    dt, count = jnp.asarray(1.0), 40_000
    draws = np.asarray(motion.draws(jax.random.key(3), count, dt)).T
    assert draws.shape == (count, 1)
    law = stats.gamma(shape, scale=1.0 / rate)
    assert draws.mean() == pytest.approx(shape / rate, abs=4.0 * law.std() / np.sqrt(count))
    assert draws.var() == pytest.approx(shape / rate**2, rel=0.06)
    assert float(motion.noise_cov(dt)[0, 0]) == pytest.approx(shape / rate**2)
    assert stats.kstest(draws[:4000, 0], law.cdf).pvalue > 1e-3
    density = jax.vmap(lambda v: motion.log_density(v, dt))
    at = np.linspace(0.01, law.ppf(0.9999), 200)
    np.testing.assert_allclose(density(jnp.asarray(at)[:, None]), law.logpdf(at), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(density(jnp.asarray([[-1.0], [0.0]])), -np.inf)
    one = jax.jit(lambda v: jnp.exp(motion.log_density(v[None], dt)))
    assert quad(lambda v: float(one(v)), 0.0, float(law.ppf(1.0 - 1e-14)))[0] == pytest.approx(1.0, abs=1e-8)


def test_derivatives_of_the_gamma_density_are_finite_where_it_is_zero():
    motion = Growth(jnp.asarray(0.1), jnp.asarray(2.0), 3)
    slope = jax.grad(lambda v: motion.log_density(v, jnp.asarray(1.0)))
    for v in (-1.0, 0.0):
        assert float(slope(jnp.asarray([v]))[0]) == 0.0
    assert float(slope(jnp.asarray([0.5]))[0]) == pytest.approx(2.0 / 0.5 - 2.0)

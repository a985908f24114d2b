"""Kalman filters of points against plain NumPy, theory and each other."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.stats import chi2

import emt.filters.catalogue  # noqa: F401 - registers the filters
from emt.config.load import load_experiment
from emt.filters.riccati import steady_covariance
from emt.filters.ukf import weights_of
from emt.filters.unscented import Spread
from emt.models.state_space.model import state_space_model
from emt.montecarlo.program import Program
from tests.filters.cases import pick
from tests.filters.point_cases import (
    EKF,
    KALMAN,
    N_STEPS,
    PREDICTOR,
    QUICK,
    RULES,
    SCALING,
    STEADY,
    UKF,
    answers,
    assert_close,
    assert_oracle,
    bearing_worlds,
    build,
    ekf_step,
    growth_worlds,
    kinematic,
    linear_worlds,
    oracle,
    random_cov,
    textbook,
    tracked,
    ukf_step,
    white,
    world_of,
)
from tests.reference import kalman, unscented


@pytest.mark.parametrize("settings", [KALMAN, EKF], ids=["kalman", "ekf"])
def test_filters_of_linear_models_are_the_textbook_kalman_filter(settings):
    for world, answer in zip(linear_worlds(), answers(settings, linear_worlds()), strict=True):
        assert_oracle(answer, oracle(ekf_step, world))


def test_the_predictor_form_is_that_of_the_textbook():
    """Also where a scan is empty."""
    for world, answer in zip(linear_worlds(), answers(PREDICTOR, linear_worlds()), strict=True):
        x, P = np.asarray(world.prior.mean), np.asarray(world.prior.cov)
        motion, H, R = (
            world.model.motions[0],
            *map(np.asarray, (world.model.measurement.matrix, world.model.measurement.cov)),
        )
        F, b, Q = np.asarray(motion.transition), np.asarray(motion.offset), np.asarray(motion.cov)
        x, P = kalman.predict(x, P, F, b, Q)
        for k in range(N_STEPS):
            assert_close(answer.estimate.mean[k], x)
            assert_close(answer.estimate.cov[k], P)
            z, seen = np.asarray(world.scans.points[k, 0]), bool(world.scans.mask[k, 0])
            if seen:
                expected = kalman.update(x, P, z, H, R)[2:]
                assert_close([answer.info.log_likelihood[k], answer.info.nis[k]], expected)
            x, P = kalman.predictor_step(x, P, z, F, b, Q, H, R) if seen else kalman.predict(x, P, F, b, Q)


def test_predictions_are_the_transition_of_filtered_states():
    """Both forms of the filter agree to 1e-12, means and covariances."""
    filtered, ahead = answers(KALMAN, linear_worlds()), answers(PREDICTOR, linear_worlds())
    for world, f, p in zip(linear_worlds(), filtered, ahead, strict=True):
        F, b, Q = map(
            np.asarray, (world.model.motions[0].transition, world.model.motions[0].offset, world.model.motions[0].cov)
        )
        assert_close(p.estimate.mean[1:], f.estimate.mean[:-1] @ F.T + b, 1e-12)
        assert_close(p.estimate.cov[1:], F @ f.estimate.cov[:-1] @ F.T + Q, 1e-12)
        assert_close(p.info.log_likelihood, f.info.log_likelihood, 1e-12)


def test_the_steady_filter_has_the_gain_of_infinitely_many_steps():
    for world, answer in zip(linear_worlds(), answers(STEADY, linear_worlds()), strict=True):
        motion, H, R = (
            world.model.motions[0],
            *map(np.asarray, (world.model.measurement.matrix, world.model.measurement.cov)),
        )
        F, b, Q = np.asarray(motion.transition), np.asarray(motion.offset), np.asarray(motion.cov)
        P = solve_discrete_are(F.T, H.T, Q, R)
        x = np.asarray(world.prior.mean)
        for k in range(N_STEPS):
            x, after = F @ x + b, P
            if bool(world.scans.mask[k, 0]):
                x, after, _, _ = kalman.update(x, P, np.asarray(world.scans.points[k, 0]), H, R)
            assert_close(answer.estimate.mean[k], x)
            assert_close(answer.estimate.cov[k], after)


@pytest.mark.parametrize("turning", [False, True], ids=["constant velocity", "gaining speed"])
def test_the_extended_filter_of_ranges_and_bearings(turning):
    worlds = bearing_worlds(turning)
    for world, answer in zip(worlds, answers(EKF, worlds), strict=True):
        bearings = np.asarray(world.scans.points)[np.asarray(world.scans.mask)][:, 1]
        assert np.abs(np.diff(bearings)).max() > 4.0
        assert_oracle(answer, oracle(ekf_step, world))


@pytest.mark.parametrize("rule", RULES)
def test_the_unscented_filter_of_ranges_and_bearings(rule):
    worlds = bearing_worlds(turning=True)
    for world, answer in zip(worlds, answers({**UKF, "points": rule}, worlds), strict=True):
        assert_oracle(answer, oracle(partial(ukf_step, rule, SCALING), world))


@pytest.mark.parametrize("settings", [EKF, {**UKF, "points": "augmented"}], ids=["ekf", "ukf"])
def test_motion_and_measurement_that_depend_on_time(settings):
    step = ekf_step if settings is EKF else partial(ukf_step, "augmented", SCALING)
    for world, answer in zip(growth_worlds(), answers(settings, growth_worlds()), strict=True):
        assert_oracle(answer, oracle(step, world))


@pytest.mark.parametrize("rule", RULES)
def test_a_first_scan_without_a_prediction(rule):
    """It meets the prior: points of the prior, whichever the rule, and the next steps go on from there."""
    world = bearing_worlds()[0]
    answer = tracked({**UKF, "points": rule}, world, first=False)
    s = textbook(world)[0]
    x, P, z = np.asarray(world.prior.mean), np.asarray(world.prior.cov), np.asarray(world.scans.points[0, 0])
    still = s._replace(f=lambda x: x, Q=np.zeros((4, 4)))
    for k, now in ((0, still), (1, textbook(world)[1])):
        z = np.asarray(world.scans.points[k, 0]) if bool(world.scans.mask[k, 0]) else None
        x, P, log_likelihood, nis = ukf_step(rule, SCALING, x, P, z, now)
        assert_close(answer.estimate.mean[k], x)
        assert_close(answer.estimate.cov[k], P)
        assert_close([answer.info.log_likelihood[k], answer.info.nis[k]], [log_likelihood, nis])


@pytest.mark.bits
@pytest.mark.parametrize(
    "settings", [KALMAN, PREDICTOR, {**UKF, "points": "redrawn"}], ids=["kalman", "predictor", "ukf"]
)
def test_empty_scans_leave_the_prediction_as_it_is(settings):
    """To the last bit, whatever the padding holds."""
    world = bearing_worlds()[0] if settings["kind"] == "ukf" else linear_worlds()[0]
    params, make = build(settings)
    flt = make(params, world.model)
    start = flt.init(world.prior, world.key)
    ahead = jax.jit(lambda: flt.predict(start, world.dt[0], world.key), compiler_options=QUICK)()
    update = jax.jit(lambda scan: flt.update(ahead, scan, world.key), compiler_options=QUICK)
    scan = pick(world.scans, 0)
    for points in (scan.points, jnp.full_like(scan.points, jnp.nan)):
        after, info = update(scan._replace(points=points, mask=jnp.zeros_like(scan.mask)))
        for ours, theirs in zip(jax.tree.leaves(after.state), jax.tree.leaves(ahead.state), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert (float(info.log_likelihood), float(info.nis), int(info.status)) == (0.0, 0.0, 0)
    changed = zip(jax.tree.leaves(update(scan)[0].state), jax.tree.leaves(ahead.state), strict=True)
    assert any((ours != theirs).any() for ours, theirs in changed)


def test_redrawn_points_make_a_linear_model_exact():
    for plain, sigma in zip(
        answers(KALMAN, linear_worlds()), answers({**UKF, "points": "redrawn"}, linear_worlds()), strict=True
    ):
        assert_close(sigma.estimate.mean, plain.estimate.mean)
        assert_close(sigma.estimate.cov, plain.estimate.cov)
        assert_close(sigma.info.log_likelihood, plain.info.log_likelihood)


def test_points_that_were_propagated_lack_the_noise():
    """They are another filter, not another way to write the same one."""
    means = [answers({**UKF, "points": rule}, bearing_worlds(turning=True))[0].estimate.mean for rule in RULES]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(means[a] - means[b]).max() > 1e-3


# the steady state of experiment A


def experiment_a(steps: int = 100):
    """The linear experiment: its settings, and a world without scans."""
    experiment = load_experiment("azimian2005/linear", [f"scenario.steps={steps}", "skip_steps=0"]).experiment
    model, prior = state_space_model(experiment.model), experiment.model.prior
    return experiment, world_of(model, prior.mean, prior.cov, np.zeros((steps, 2)))


def test_steady_covariances_solve_the_riccati_equation():
    solve = jax.jit(steady_covariance, compiler_options=QUICK)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        F, H = rng.normal(size=(4, 4)), rng.normal(size=(2, 4))
        Q, R = random_cov(rng, 4), random_cov(rng, 2)
        found = np.asarray(solve(*map(jnp.asarray, (F, H, Q, R))))
        assert_close(found, solve_discrete_are(F.T, H.T, Q, R))
        np.testing.assert_array_equal(found, found.T)


def test_a_hundred_steps_of_experiment_a_reach_the_steady_state():
    """Within 1e-9, and the numbers of theory: variances and gains per axis."""
    _, world = experiment_a()
    answer = tracked(KALMAN, world)
    F, Q, H, R = kinematic(1.0), white(0.1, 1.0), np.eye(2, 4), 100.0 * np.eye(2)
    found = np.asarray(steady_covariance(*map(jnp.asarray, (F, H, Q, R))))
    np.testing.assert_allclose(found, solve_discrete_are(F.T, H.T, Q, R), rtol=1e-9, atol=1e-9)
    ahead = F @ answer.estimate.cov @ F.T + Q
    np.testing.assert_allclose(ahead[-2], found, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.diagonal(found), [28.593567, 28.593567, 0.847368, 0.847368], atol=5e-7)
    filtered = answer.estimate.cov[-1]
    np.testing.assert_allclose(np.diagonal(filtered), [22.235612, 22.235612, 0.747368, 0.747368], atol=5e-7)
    gain = found @ H.T @ np.linalg.inv(H @ found @ H.T + R)
    np.testing.assert_allclose(gain, np.kron([[0.222356], [0.027886]], np.eye(2)), atol=5e-7)
    assert np.sqrt(np.trace(filtered[:2, :2])) == pytest.approx(6.6687, abs=5e-5)
    assert np.sqrt(np.trace(filtered[2:, 2:])) == pytest.approx(1.2226, abs=5e-5)
    assert np.abs(ahead[9] - found).max() > 1e-2  # it takes its time


def test_the_kalman_filter_is_consistent_with_its_own_model():
    """Mean NEES of 64 runs at the last of 20 steps, and mean NIS of all steps, inside their 99.8 % bands."""
    experiment, _ = experiment_a(20)
    experiment = experiment.model_copy(update={"filters": {"kf": experiment.filters["kf"]}, "metrics": ("nees", "nis")})
    program = Program.of(experiment)

    def scores(run):
        simulation = program.simulate_run(program.world, jnp.asarray(5), run)
        return program.score_run(
            "kf", program.world, program.filter_params["kf"], jnp.asarray(5), run, simulation.scans, simulation.truth
        ).per_step

    runs = 64
    steps = np.asarray(jax.jit(jax.vmap(scores), compiler_options=QUICK)(jnp.arange(runs)))
    assert steps.shape == (runs, 20, 2)
    low, high = chi2.ppf([0.001, 0.999], 4 * runs) / runs
    assert low < steps[:, -1, 0].mean() < high
    low, high = chi2.ppf([0.001, 0.999], 2 * runs * 20) / (runs * 20)
    assert low < steps[:, :, 1].mean() < high


def test_weights_of_the_points_are_those_of_the_survey():
    """W = λ / (n + λ) in means, 1 - α² + β more in covariances, and 1 / (2 (n + λ)) for all others."""
    for n, scaling in ((4, SCALING), (1, unscented.Scaling(1.0, 0.0, 2.0)), (8, unscented.Scaling(1e-2, 2.0, 0.0))):
        spread = Spread(*map(jnp.asarray, (scaling.alpha, scaling.kappa, scaling.beta)))
        for ours, theirs in zip(weights_of(spread, n), unscented.weights(n, scaling), strict=True):
            assert_close(ours, theirs, 1e-12)

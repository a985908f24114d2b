"""The slow oracles of the classical filters against vectors made by running public code, and against each other.

Every test of vectors runs on the excerpts in tests/golden and, where they are at hand, on the whole files. Runs are
open loop: each scan starts from the oracle's own previous result, never from a stored one.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from tests.reference import kalman, multiple_model, particle, unscented, variable_structure

TIGHT = 1e-10


def array(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, dtype=np.float64)


def assert_close(actual: ArrayLike, expected: ArrayLike, what: str) -> None:
    """Largest difference, relative to the largest magnitude of the expected quantity."""
    actual, expected = array(actual), array(expected)
    assert actual.shape == expected.shape, what
    error = np.max(np.abs(actual - expected)) / np.max(np.abs(expected))
    assert error <= TIGHT, f"{what}: relative error {error:.3g}"


@pytest.fixture(params=["excerpt", "whole file"])
def folder(request: pytest.FixtureRequest) -> Path:
    return Path(__file__).parents[1] / "golden" if request.param == "excerpt" else request.getfixturevalue("golden")


def cases(folder: Path, name: str) -> list[dict[str, Any]]:
    return json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))["cases"]


def range_bearing(x: NDArray) -> NDArray:
    return np.array([np.hypot(x[0], x[2]), np.arctan2(x[2], x[0])])


def range_bearing_jacobian(x: NDArray) -> NDArray:
    r = np.hypot(x[0], x[2])
    return np.array([[x[0] / r, 0.0, x[2] / r, 0.0], [-x[2] / r**2, 0.0, x[0] / r**2, 0.0]])


def test_ekf(folder: Path) -> None:
    for number, case in enumerate(cases(folder, "ekf")):
        F, Q, R, x, P = (array(case[key]) for key in ("F", "Q", "R", "x0", "P0"))
        for k, step in enumerate(case["steps"]):
            what = f"case {number}, scan {k}"
            x, P = kalman.extended_predict(x, P, lambda x, F=F: F @ x, lambda _, F=F: F, Q)
            assert_close(x, step["x_prior"], f"{what}: predicted x")
            assert_close(P, step["P_prior"], f"{what}: predicted P")
            assert_close(range_bearing_jacobian(x), step["H"], f"{what}: H")
            numerical = kalman.numerical_jacobian(range_bearing, x, (False, True))
            np.testing.assert_allclose(numerical, step["H"], rtol=0, atol=1e-8)
            z = array(step["z"])
            x, P, log_likelihood, nis = kalman.extended_update(
                x, P, z, range_bearing, range_bearing_jacobian, R, (False, True)
            )
            assert_close(x, step["x"], f"{what}: x")
            assert_close(P, step["P"], f"{what}: P")
            assert_close(log_likelihood, step["log_likelihood"], f"{what}: log-likelihood")
            assert_close(nis, array(step["y"]) @ np.linalg.solve(step["S"], step["y"]), f"{what}: NIS")


def test_ukf(folder: Path) -> None:
    for number, case in enumerate(cases(folder, "ukf")):
        F, Q, R, x, P = (array(case[key]) for key in ("F", "Q", "R", "x0", "P0"))
        scaling = unscented.Scaling(case["alpha"], case["beta"], case["kappa"])
        for got, key in zip(unscented.weights(4, scaling), ("Wm", "Wc"), strict=True):
            assert_close(got, case[key], f"case {number}: {key}")
        for k, step in enumerate(case["steps"]):
            what = f"case {number}, scan {k}"
            assert_close(unscented.sigma_points(x, P, scaling), step["sigmas"], f"{what}: points")
            z, f = array(step["z"]), lambda x, F=F: F @ x
            after = unscented.redrawn_step(x, P, z, f, Q, range_bearing, R, scaling, (False, True))
            x, P = unscented.predict(x, P, f, Q, scaling)
            assert_close(x, step["x_prior"], f"{what}: predicted x")
            assert_close(P, step["P_prior"], f"{what}: predicted P")
            assert_close(unscented.sigma_points(x, P, scaling), step["sigmas_f"], f"{what}: predicted points")
            x, P, _, nis = after
            assert_close(x, step["x"], f"{what}: x")
            assert_close(P, step["P"], f"{what}: P")
            assert_close(nis, array(step["y"]) @ np.linalg.solve(step["S"], step["y"]), f"{what}: NIS")


def test_imm(folder: Path) -> None:
    for number, case in enumerate(cases(folder, "imm")):
        F, Q, H, R, pi = (array(case[key]) for key in ("F", "Q", "H", "R", "M"))
        models = [(F_i, np.zeros(4), Q_i) for F_i, Q_i in zip(F, Q, strict=True)]
        state = multiple_model.State(array(case["x0"]), array(case["P0"]), np.log(case["mu0"]))
        for k, step in enumerate(case["steps"]):
            what, z = f"case {number}, scan {k}", array(step["z"])
            W = multiple_model.mixing_weights(state.log_mu, pi)
            assert_close(W, step["mixing"], f"{what}: mixing weights")
            predicted = np.exp(multiple_model.predicted_probabilities(state.log_mu, pi))
            assert_close(predicted, step["cbar"], f"{what}: predicted probabilities")
            for i, model in enumerate(models):
                x, P = kalman.predict(*multiple_model.merged(W[:, i], state.x, state.P), *model)
                assert_close(x, step["model_x_prior"][i], f"{what}, model {i}: predicted x")
                likelihood = np.exp(kalman.update(x, P, z, H, R)[2])
                assert_close(likelihood, step["likelihood"][i], f"{what}, model {i}: likelihood")
            state, mean, cov = multiple_model.imm_step(state, z, models, H, R, pi)
            assert_close(np.exp(state.log_mu), step["mu"], f"{what}: probabilities")
            assert_close(state.x, step["model_x"], f"{what}: x of the models")
            assert_close(state.P, step["model_P"], f"{what}: P of the models")
            assert_close(mean, step["x"], f"{what}: x")
            assert_close(cov, step["P"], f"{what}: P")


def numbers(values: ArrayLike) -> set[int]:
    """Model numbers from 0 of a list of numbers from 1, however nested."""
    return {int(i) - 1 for i in np.ravel(values)}


def test_vsimm(folder: Path) -> None:
    # The code is the LMS cycle with the "and" rule: strategy 2 has K = n_min, strategy 1 has K = 0. It ends a scan by
    # mixing the union into the next set, and so starts from a prediction: the first scan is filtered over models 1-5
    # only, all others masked (null), without mixing and without adaptation. Its P is the transpose of pi.
    for number, case in enumerate(cases(folder, "vsimm")):
        A, Q, H, R = (array(case[key]) for key in ("A", "Sigmaw", "C", "Sigmav"))
        models = [(A, b, Q) for b in (array(case["Bq"]) @ array(case["a"])).T]
        fixed = {"models": models, "H": H, "R": R, "pi": array(case["P"]).T}
        (t1, t2), K = case["thresholds"], case["n_min"] if case["strategy"] == 2 else 0
        active, start = set(range(5)), (array(case["xp0"])[:, 0], array(case["P0"]))
        posterior = None
        for k, step in enumerate(case["steps"]):
            what, z = f"case {number}, scan {k}", array(step["y"])[:, 0]
            assert active == numbers(step["active_pred"]), what
            if posterior is None:
                log_mu = np.log(array(case["pmup0"])[:, 0])
                results = {i: variable_structure.conditioned(log_mu[i], *start, z, H, R) for i in active}
                posterior = variable_structure.posterior(results)
                mean, _ = variable_structure.fused(posterior)
                unlikely, adjacent = set(), set()
            else:
                results = variable_structure.cycle(active, posterior, z, **fixed)
                end = variable_structure.lms_adapt(results, posterior, z, **fixed, t1=t1, t2=t2, K=K)
                posterior, mean, _, unlikely, adjacent, active = end
            predicted = {i: np.exp(r.log_predicted) for i, r in results.items() if r is not None}
            assert unlikely == numbers(step["unlikely"]), what
            assert adjacent == numbers(step["adjacent"]), what
            assert set(posterior.log_mu) == numbers(step["active_post"]), what
            assert active == numbers(step["active_next"]), what
            stored = array([np.nan if v is None else v for v in np.ravel(step["pmup"])])
            assert set(np.flatnonzero(np.isfinite(stored))) == set(predicted), what
            assert_close([predicted[i] for i in sorted(predicted)], stored[sorted(predicted)], f"{what}: predicted mu")
            members = sorted(posterior.log_mu)
            mu = array([np.exp(posterior.log_mu[i]) for i in members])
            assert_close(mu, array([step["pmuf"][i][0] for i in members]), f"{what}: mu")
            x = np.stack([posterior.x[i] for i in members], axis=1)
            assert_close(x, array([[row[i] for i in members] for row in step["xf"]]), f"{what}: x of the models")
            P = np.stack([posterior.P[i] for i in members])
            assert_close(P, step["Pxxf"], f"{what}: P of the models")
            assert_close(mean, array(step["x"])[:, 0], f"{what}: x")


F = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
Q = np.kron(np.eye(2), [[1.0 / 3.0, 0.5], [0.5, 1.0]])
H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
R = np.diag([4.0, 9.0])
X0, P0 = np.array([1.0, 2.0, -3.0, 0.5]), np.diag([5.0, 1.0, 5.0, 2.0]) + 0.2
B = np.array([0.5, 1.0, 0.0, 0.0])
SCANS = np.random.default_rng(3).normal(0.0, 3.0, (6, 2)) + np.arange(6)[:, None] * [2.0, 0.5]


def test_predictor_form_is_the_prediction_of_the_filtered_state() -> None:
    x, P = X0, P0
    for z in SCANS:
        expected = kalman.predict(*kalman.update(x, P, z, H, R)[:2], F, B, Q)
        x, P = kalman.predictor_step(x, P, z, F, B, Q, H, R)
        assert_close(x, expected[0], "x")
        assert_close(P, expected[1], "P")


@pytest.mark.parametrize("scaling", [(1.0, 2.0, 0.0), (0.5, 2.0, 1.0)])
def test_unscented_forms_on_a_linear_model(scaling: tuple[float, float, float]) -> None:
    """Two forms are the Kalman filter; with the points kept, Q enters the covariance but not the gain."""
    settings, z = unscented.Scaling(*scaling), SCANS[0]
    x, P = kalman.predict(X0, P0, F, B, Q)
    expected = kalman.update(x, P, z, H, R)
    redrawn = unscented.redrawn_step(X0, P0, z, lambda x: F @ x + B, Q, lambda x: H @ x, R, settings)
    augmented = unscented.augmented_step(X0, P0, z, lambda x, v: F @ x + B + v, Q, lambda x: H @ x, R, settings)
    kept = unscented.kept_step(X0, P0, z, lambda x: F @ x + B, Q, lambda x: H @ x, R, settings)
    without = kalman.update(x, P - Q, z, H, R)
    for got, wanted in ((redrawn, expected), (augmented, expected), (kept, (without[0], without[1] + Q, *without[2:]))):
        for a, b in zip(got, wanted, strict=True):
            assert_close(a, b, "linear model")


def test_bearings_beyond_half_a_turn() -> None:
    """A quarter turn of everything changes nothing, though bearings pass the end of their range."""
    scaling, R = unscented.Scaling(1.0, 2.0, 0.0), np.diag([1.0, 0.01])
    turn = np.kron([[0.0, -1.0], [1.0, 0.0]], np.eye(2))  # x, vx, y, vy
    x, P = np.array([-1.0, 0.0, 20.0, 0.0]), np.diag([9.0, 1.0, 16.0, 1.0])
    z = np.array([21.0, 1.55])
    turned = np.array([21.0, 1.55 + 0.5 * np.pi - 2.0 * np.pi])
    for step in (
        lambda x, P, z: unscented.update(x, P, z, range_bearing, R, scaling, (False, True)),
        lambda x, P, z: kalman.extended_update(x, P, z, range_bearing, range_bearing_jacobian, R, (False, True)),
    ):
        a, b = step(x, P, z), step(turn @ x, turn @ P @ turn.T, turned)
        assert_close(b[0], turn @ a[0], "x")
        assert_close(b[2:], a[2:], "log-likelihood and NIS")


PI = np.array([[0.9, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.1, 0.9]])
MODELS = [(F, B * a, Q * q) for a, q in ((0.0, 0.01), (1.0, 0.1), (-1.0, 1.0))]


def test_variable_structure_with_all_models_is_the_imm_filter() -> None:
    """Also while a model has no predecessor: the third at the first scan."""
    fixed = multiple_model.State(np.stack([X0] * 3), np.stack([P0] * 3), multiple_model.log(np.array([1.0, 0.0, 0.0])))
    free = variable_structure.start({0, 1, 2}, {0: 1.0}, X0, P0)
    for z in SCANS:
        fixed, mean, cov = multiple_model.imm_step(fixed, z, MODELS, H, R, PI)
        step = variable_structure.lms_cycle({0, 1, 2}, free, z, MODELS, H, R, PI, t1=0.0, t2=0.9, K=3)
        free = step.posterior
        assert_close(step.mean, mean, "x")
        assert_close(step.cov, cov, "P")
        np.testing.assert_allclose([free.log_mu[i] for i in range(3)], fixed.log_mu, rtol=1e-12)


def test_all_filters_agree_where_models_are_alike() -> None:
    """With one model three times, every bank is a single Kalman filter, and the probabilities follow the chain."""
    models, x, P, mu = [MODELS[1]] * 3, X0, P0, np.array([0.5, 0.3, 0.2])
    bank = multiple_model.State(np.stack([X0] * 3), np.stack([P0] * 3), np.log(mu))
    still = imm = gpb2 = bank
    one = X0, P0, np.log(mu)
    group = variable_structure.MgsState(variable_structure.start({0, 1}, {0: 0.6, 1: 0.4}, X0, P0), 0, None, 0.0)
    groups = [{0, 1}, {1, 2}]
    for z in SCANS:
        x, P, _, _ = multiple_model.filtered(x, P, z, MODELS[1], H, R)
        mu = mu @ PI
        still, *a = multiple_model.static_step(still, z, models, H, R, floor=1e-3)
        imm, *b = multiple_model.imm_step(imm, z, models, H, R, PI)
        gpb2, *c = multiple_model.gpb2_step(gpb2, z, models, H, R, PI)
        one = multiple_model.gpb1_step(*one, z, models, H, R, PI)
        step = variable_structure.mgs_cycle(group, groups, z, models, H, R, PI, 0.3, 0.1, 10.0, 0.1, 10.0)
        group = step.state
        for mean, cov in (a, b, c, one[:2], (step.mean, step.cov)):
            assert_close(mean, x, "x")
            assert_close(cov, P, "P")
        for log_mu in (imm.log_mu, gpb2.log_mu, one[2]):
            assert_close(np.exp(log_mu), mu, "mu")
        assert_close(np.exp(still.log_mu), [0.5, 0.3, 0.2], "static mu")
        assert step.used == {0, 1, 2}
        assert group.candidate == 1


def test_systematic_resampling_and_effective_samples() -> None:
    weights = np.array([0.1, 0.0, 0.5, 0.4])
    np.testing.assert_array_equal(particle.systematic_resample(weights, 0.3), [0, 2, 2, 3])
    np.testing.assert_array_equal(particle.systematic_resample(weights, 0.5), [2, 2, 3, 3])
    np.testing.assert_array_equal(particle.systematic_resample(np.full(7, 1.0 / 7.0), 0.999), np.arange(7))
    assert particle.effective_samples(np.full(7, 1.0 / 7.0)) == pytest.approx(7.0)


def test_particle_filters_approach_the_kalman_filter() -> None:
    """The optimal proposal leaves more effective particles than the prior."""
    N, generator = 2000, np.random.default_rng(5)
    root = np.linalg.cholesky(Q)
    x, P = X0, P0
    plain = X0 + generator.normal(size=(N, 4)) @ np.linalg.cholesky(P0).T
    guided, none, flat = plain, np.zeros((N, 4, 4)), np.full(N, -np.log(N))
    log_w = log_g = flat

    def log_likelihood(z: NDArray, x: NDArray) -> float:
        return kalman.log_gaussian(z - H @ x, R)

    def log_transition(x: NDArray, before: NDArray) -> float:
        return kalman.log_gaussian(x - F @ before - B, Q)

    def proposal(x: NDArray, _: NDArray, z: NDArray) -> tuple[NDArray, NDArray]:
        return kalman.update(F @ x + B, Q, z, H, R)[:2]

    for offset in ([1.0, -1.0], [2.0, 1.0], [-1.0, 3.0]):
        x, P = kalman.predict(x, P, F, B, Q)
        z = H @ x + offset
        x, P, _, _ = kalman.update(x, P, z, H, R)
        noise, u = generator.normal(size=(N, 4)), generator.uniform()
        a = particle.bootstrap_step(plain, log_w, z, u, noise, lambda p, v: F @ p + B + root @ v, log_likelihood)
        b = particle.proposal_step(guided, none, log_g, z, u, noise, proposal, log_transition, log_likelihood)
        (plain, log_w), (guided, log_g) = (a.particles, a.log_weights), (b.particles, b.log_weights)
        for result in (a, b):
            assert np.all(np.abs(result.mean - x) < 0.15 * np.sqrt(np.diag(P)))
            np.testing.assert_allclose(result.cov, P, rtol=0, atol=0.15 * np.max(P))
        assert particle.effective_samples(np.exp(log_g)) > particle.effective_samples(np.exp(log_w))

"""Checks of the slow textbook oracles against quadrature and against properties the papers state."""

import numpy as np
import pytest
from scipy import stats

from tests.reference import feldmann, mem_ekf_star, vb
from tests.reference.sampled_posterior import condition_on_extent, extents, sampled_posterior

H = vb.H
X0 = np.array([10.0, -4.0, 1.0, 2.0])
P0 = np.diag([4.0, 3.0, 1.0, 1.0]) + 0.3
R = np.array([[1.2, 0.3], [0.3, 0.8]])
SHAPES, SCALES = np.array([5.0, 6.0]), np.array([400.0, 60.0])


def scan(m: int, seed: int, theta: float = 0.6) -> np.ndarray:
    """m Gaussian measurements of an ellipse with semi-axes 10 and 3 near X0."""
    generator = np.random.default_rng(seed)
    covariance = vb.rotation(theta) @ np.diag([100.0, 9.0]) @ vb.rotation(theta).T + R
    return generator.multivariate_normal(X0[:2] + 1.0, covariance, size=m)


@pytest.mark.parametrize(("mean", "variance"), [(0.0, 0.01), (0.7, 0.2), (-2.5, 1.0), (40.0, 0.05)])
def test_lemma_1_matches_quadrature(mean: float, variance: float) -> None:
    M = np.array([[3.0, -1.0], [0.5, 7.0]])
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    forward, backward = np.zeros((2, 2)), np.zeros((2, 2))
    for node, weight in zip(nodes, weights / np.sum(weights), strict=True):
        L = vb.rotation(mean + np.sqrt(variance) * node)
        forward += weight * L @ M @ L.T
        backward += weight * L.T @ M @ L
    np.testing.assert_allclose(vb.expected_rotation(M, mean, variance), forward, rtol=0, atol=1e-12)
    np.testing.assert_allclose(vb.expected_back_rotation(M, mean, variance), backward, rtol=0, atol=1e-12)


def test_rotation_derivative_matches_finite_difference() -> None:
    difference = (vb.rotation(0.7 + 1e-6) - vb.rotation(0.7 - 1e-6)) / 2e-6
    np.testing.assert_allclose(vb.rotation_derivative(0.7), difference, rtol=0, atol=1e-9)


def test_row_jacobians_match_finite_differences() -> None:
    p = np.array([0.7, 8.0, 3.0])
    J1, J2 = mem_ekf_star.row_jacobians(p)
    for column in range(3):
        step = 1e-5 * np.eye(3)[column]
        slope = (mem_ekf_star.shape_matrix(p + step) - mem_ekf_star.shape_matrix(p - step)) / 2e-5
        np.testing.assert_allclose(np.vstack([J1[:, column], J2[:, column]]), slope, rtol=0, atol=1e-8)


def test_scan_without_measurements_returns_the_prediction() -> None:
    none = np.zeros((0, 2))
    state = (X0, P0, 0.4, 0.1, SHAPES, SCALES)
    for before, after in zip(state, vb.update(*state, none, R, 0.25, 10), strict=True):
        np.testing.assert_array_equal(after, before)
    extent = np.diag([100.0, 9.0])
    state = (X0, P0, extent, 8.0)
    for before, after in zip(state, feldmann.update(*state, none, R, 0.25), strict=True):
        np.testing.assert_array_equal(after, before)
    p, Cp = np.array([0.4, 10.0, 3.0]), np.diag([0.1, 4.0, 1.0])
    state = (X0, P0, p, Cp)
    for before, after in zip(state, mem_ekf_star.update(*state, none, 0.25 * np.eye(2), R), strict=True):
        np.testing.assert_array_equal(after, before)


def test_vb_ignores_the_order_of_measurements_and_mem_ekf_star_does_not() -> None:
    y = scan(6, 3)
    state = (X0, P0, 0.4, 0.1, SHAPES, SCALES)
    forward, reverse = vb.update(*state, y, R, 1.0, 10), vb.update(*state, y[::-1], R, 1.0, 10)
    for one, other in zip(forward, reverse, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-12)
    state = (X0, P0, np.array([0.4, 10.0, 3.0]), np.diag([0.1, 4.0, 1.0]))
    p = mem_ekf_star.update(*state, y, np.eye(2), R)[2]
    p_reversed = mem_ekf_star.update(*state, y[::-1], np.eye(2), R)[2]
    assert np.max(np.abs(p - p_reversed)) > 1e-6


def test_gottingen_and_major_axis_read_outs_name_the_same_ellipse() -> None:
    for theta in (0.3, 1.2, -0.3, -1.2):
        X = vb.rotation(theta) @ np.diag([100.0, 9.0]) @ vb.rotation(theta).T
        angle, axes = feldmann.gottingen_read_out(X)
        assert 0.0 < angle < 0.5 * np.pi
        L = vb.rotation(angle)
        np.testing.assert_allclose(L @ np.diag(axes**2) @ L.T, X, rtol=1e-12)
        angle, axes = feldmann.major_axis_read_out(X)
        assert angle == pytest.approx(theta, abs=1e-12)
        np.testing.assert_allclose(axes, [10.0, 3.0], rtol=1e-12)


def test_major_axis_read_out_of_axis_parallel_ellipses() -> None:
    assert feldmann.major_axis_read_out(np.diag([4.0, 1.0]))[0] == 0.0
    assert feldmann.major_axis_read_out(np.diag([1.0, 4.0]))[0] == pytest.approx(0.5 * np.pi)
    assert np.isnan(feldmann.gottingen_read_out(np.diag([4.0, 1.0]))[0])


def test_decay_rules_of_the_random_matrix_weight() -> None:
    F, Q, X = np.eye(4), np.zeros((4, 4)), np.diag([100.0, 9.0])
    assert feldmann.predict(X0, P0, X, 12.0, F, Q, 1.0, 20.0)[3] == pytest.approx(2.0 + 10.0 * np.exp(-0.05))
    _, _, X_kept, alpha = feldmann.predict_weight_decay(X0, P0, X, 12.0, F, Q, 0.9)
    np.testing.assert_array_equal(X_kept, X)
    assert alpha == pytest.approx(10.8)
    _, _, X_grown, alpha = feldmann.predict_inverse_wishart_decay(X0, P0, X, 14.0, F, Q, 0.99)
    assert alpha == pytest.approx(0.99 * 20.0 - 6.0)
    np.testing.assert_allclose(X_grown, X * 0.99 * 14.0 / (0.99 * 20.0 - 6.0), rtol=1e-14)
    _, _, X_kept, alpha = feldmann.predict_inverse_wishart_decay(X0, P0, X, 1.0, F, Q, 0.5)
    assert alpha == pytest.approx(1.0)
    np.testing.assert_allclose(X_kept, X, rtol=1e-14)


def test_conditional_likelihood_matches_the_stacked_gaussian() -> None:
    y = scan(4, 7)
    theta, X = np.array([0.4, -1.0]), np.array([[90.0, 8.0], [30.0, 20.0]])
    C = 0.25 * extents(theta, X) + R
    means, covariances, log_likelihood = condition_on_extent(X0, P0, C, y)
    A = np.kron(np.ones((4, 1)), H)
    for i in range(2):
        S = A @ P0 @ A.T + np.kron(np.eye(4), C[i])
        gain = P0 @ A.T @ np.linalg.inv(S)
        expected = stats.multivariate_normal(A @ X0, S).logpdf(y.reshape(8))
        assert log_likelihood[i] == pytest.approx(expected, rel=1e-10)
        np.testing.assert_allclose(means[i], X0 + gain @ (y.reshape(8) - A @ X0), rtol=1e-10)
        np.testing.assert_allclose(covariances[i], P0 - gain @ A @ P0, rtol=0, atol=1e-10)


def test_sampled_posterior_matches_quadrature() -> None:
    """Product quadrature over quantiles of the three prior marginals."""
    theta0, S0, s, y = 0.4, 0.1, 1.0, scan(5, 11)
    levels = (np.arange(40) + 0.5) / 40
    grid = np.meshgrid(
        stats.norm(theta0, np.sqrt(S0)).ppf(levels),
        stats.invgamma(SHAPES[0], scale=SCALES[0]).ppf(levels),
        stats.invgamma(SHAPES[1], scale=SCALES[1]).ppf(levels),
        indexing="ij",
    )
    thetas, X = grid[0].ravel(), np.stack([grid[1].ravel(), grid[2].ravel()], axis=1)
    E = extents(thetas, X)
    means, covariances, log_likelihood = condition_on_extent(X0, P0, s * E + R, y)
    weights = np.exp(log_likelihood - np.max(log_likelihood))
    weights /= np.sum(weights)
    mean = weights @ means
    covariance = np.einsum("n,nij->ij", weights, covariances) + np.cov(means.T, aweights=weights, ddof=0)
    theta = theta0 + np.angle(np.sum(weights * np.exp(1j * (thetas - theta0))))

    posterior = sampled_posterior(X0, P0, theta0, S0, SHAPES, SCALES, y, R, s, 100_000, 5)
    assert posterior.effective_sample_size > 5_000
    np.testing.assert_allclose(posterior.x, mean, rtol=0, atol=0.02)
    np.testing.assert_allclose(posterior.P, covariance, rtol=0, atol=0.02)
    assert posterior.theta == pytest.approx(theta, abs=0.01)
    np.testing.assert_allclose(posterior.extent, np.einsum("n,nij->ij", weights, E), rtol=0.03)


def test_sampled_posterior_of_a_known_ellipse_is_the_kalman_filter() -> None:
    y, theta0, s = scan(3, 13), 0.6, 0.25
    shapes, scales = np.array([1e9, 1e9]), np.array([100.0, 9.0]) * 1e9
    posterior = sampled_posterior(X0, P0, theta0, 1e-12, shapes, scales, y, R, s, 50, 1)
    C = s * vb.rotation(theta0) @ np.diag([100.0, 9.0]) @ vb.rotation(theta0).T + R
    P = np.linalg.inv(np.linalg.inv(P0) + 3 * H.T @ np.linalg.inv(C) @ H)
    x = P @ (np.linalg.inv(P0) @ X0 + H.T @ np.linalg.inv(C) @ np.sum(y, axis=0))
    np.testing.assert_allclose(posterior.x, x, rtol=1e-4)
    np.testing.assert_allclose(posterior.P, P, rtol=0, atol=1e-3)
    assert posterior.theta == pytest.approx(theta0, abs=1e-4)


def test_vb_iterations_move_towards_the_sampled_posterior() -> None:
    start = (X0, P0, 0.2, 0.1, SHAPES, SCALES)
    y = scan(20, 17)
    posterior = sampled_posterior(*start, y, R, 1.0, 60_000, 3)
    assert posterior.effective_sample_size > 1_000
    errors = []
    for n_iterations in (0, 3, 10):
        x, _, theta, _, a, b = vb.update(*start, y, R, 1.0, n_iterations)
        L = vb.rotation(theta)
        extent = L @ np.diag(vb.semi_axes(a, b) ** 2) @ L.T
        errors.append(np.linalg.norm(extent - posterior.extent) / np.linalg.norm(posterior.extent))
    assert errors[-1] < 0.5 * errors[0]
    assert np.linalg.norm((x - posterior.x)[:2]) < 0.5
    assert abs(theta - posterior.theta) < 0.1

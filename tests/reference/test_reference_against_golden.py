"""The slow textbook oracles against vectors produced by the papers' authors' own public code.

Sequences are run open loop: each scan starts from the oracle's own previous result, never from a stored one.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.io import loadmat

from tests.reference import feldmann, gaussian_wasserstein, gp_ett, mem_ekf_star, vb

SHARED = Path(__file__).parents[3] / "shared"
GOLDEN = SHARED / "golden"
PARKING_LOT = SHARED / "data" / "metu_parking_lot" / "measurements.mat"

TIGHT = 1e-9
GP_TOLERANCE = 1e-6  # the jittered kernel matrix is nearly singular


def load(name: str) -> dict[str, Any]:
    path = GOLDEN / name
    if not path.is_file():
        pytest.skip(f"no golden vectors at {path}")
    return json.loads(path.read_text(encoding="utf-8"))


def array(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, dtype=np.float64)


def points(values: ArrayLike) -> NDArray[np.float64]:
    """Measurements as (m, 2), also when there are none."""
    return array(values).reshape(-1, 2)


def relative_error(actual: ArrayLike, expected: ArrayLike) -> float:
    """Largest difference, relative to the largest magnitude of the expected quantity."""
    actual, expected = array(actual), array(expected)
    assert actual.shape == expected.shape
    scale = np.max(np.abs(expected))
    difference = np.max(np.abs(actual - expected))
    return float(difference / scale) if scale > 0.0 else float(difference)


def assert_close(actual: ArrayLike, expected: ArrayLike, tolerance: float, what: str) -> None:
    error = relative_error(actual, expected)
    assert error <= tolerance, f"{what}: relative error {error:.3g} exceeds {tolerance:.3g}"


def assert_vb_state(
    state: vb.State, x: ArrayLike, P: ArrayLike, a: ArrayLike, b: ArrayLike, what: str
) -> None:  # fmt: skip
    """Compare with a stacked 5-vector [x, theta] and its 5x5 covariance, each part on its own scale."""
    x, P = array(x), array(P)
    assert not np.any(P[:4, 4]), f"{what}: golden covariance is not block diagonal"
    assert_close(state[0][:2], x[:2], TIGHT, f"{what}: position")
    assert_close(state[0][2:], x[2:4], TIGHT, f"{what}: velocity")
    assert_close(state[1], P[:4, :4], TIGHT, f"{what}: P")
    assert_close(state[2], x[4], TIGHT, f"{what}: theta")
    assert_close(state[3], P[4, 4], TIGHT, f"{what}: S")
    assert_close(state[4], a, TIGHT, f"{what}: shapes")
    assert_close(state[5], b, TIGHT, f"{what}: scales")


def vb_state(x: ArrayLike, P: ArrayLike, a: ArrayLike, b: ArrayLike) -> vb.State:
    x, P = array(x), array(P)
    return x[:4], P[:4, :4], float(x[4]), float(P[4, 4]), array(a), array(b)


def test_vb_cases() -> None:
    for number, case in enumerate(load("vb_update.json")["cases"]):
        start = vb_state(case["x_pred"], case["P_pred"], case["alpha_pred"], case["beta_pred"])
        end = vb.update(*start, points(case["y"]), array(case["R"]), case["scaling_s"], case["n_iterations"])
        what = f"case {number} ({case['description']})"
        assert_vb_state(end, case["x_upd"], case["P_upd"], case["alpha_upd"], case["beta_upd"], what)
        assert_close(vb.semi_axes(end[4], end[5]), case["semi_axes_upd"], TIGHT, f"{what}: semi-axes")


def test_vb_sequences() -> None:
    for number, run in enumerate(load("vb_update.json")["sequences"]):
        state = vb_state(run["x0"], run["P0"], run["alpha0"], run["beta0"])
        F, Q, R = array(run["F"]), array(run["Q"]), array(run["R"])
        assert np.array_equal(F[4], [0, 0, 0, 0, 1])
        for scan, step in enumerate(run["steps"]):
            if scan > 0:
                state = vb.predict(*state, F[:4, :4], Q[:4, :4], Q[4, 4], run["forgetting"])
            what = f"sequence {number}, scan {scan}"
            predicted = (step["x_pred"], step["P_pred"], step["alpha_pred"], step["beta_pred"])
            assert_vb_state(state, *predicted, f"{what} predicted")
            state = vb.update(*state, points(step["y"]), R, run["scaling_s"], run["n_iterations"])
            updated = (step["x_upd"], step["P_upd"], step["alpha_upd"], step["beta_upd"])
            assert_vb_state(state, *updated, f"{what} updated")
            assert_close(vb.semi_axes(state[4], state[5]), step["semi_axes_upd"], TIGHT, f"{what}: semi-axes")


def test_vb_on_parking_lot_recording() -> None:
    golden = load("real_data_vb_first20.json")
    if not PARKING_LOT.is_file():
        pytest.skip(f"no recording at {PARKING_LOT}")
    # Stored as unsigned 16-bit integers, whose differences would wrap around.
    scans = [array(cell).T for cell in loadmat(PARKING_LOT)["Z"][0]]
    settings = golden["parameters"]
    T = settings["T"]
    F = np.kron([[1.0, T], [0.0, 1.0]], np.eye(2))
    Q = np.kron([[T**3 / 3, T**2 / 2], [T**2 / 2, T]], settings["sigma_Q"] ** 2 * np.eye(2))
    state = vb_state(settings["x0"], np.diag(settings["P0_diag"]), settings["alpha0"], settings["beta0"])
    for frame in golden["frames"]:
        if frame["frame"] > 1:
            state = vb.predict(*state, F, Q, settings["Q_theta"], settings["forgetting"])
        y = scans[frame["frame"] - 1]
        assert y.shape == (frame["n_meas"], 2)
        state = vb.update(*state, y, array(settings["R"]), settings["s"], settings["n_iterations"])
        what = f"frame {frame['frame']}"
        assert_vb_state(state, frame["x"], frame["P"], frame["alpha"], frame["beta"], what)
        assert_close(vb.semi_axes(state[4], state[5]), frame["semi_axes"], TIGHT, f"{what}: semi-axes")


def assert_mem_state(state: mem_ekf_star.State, golden: dict[str, Any], suffix: str, what: str) -> None:
    r, Cr, p, Cp = state
    expected_r, expected_p = array(golden[f"r_{suffix}"]), array(golden[f"p_{suffix}"])
    assert_close(r[:2], expected_r[:2], TIGHT, f"{what}: position")
    assert_close(r[2:], expected_r[2:], TIGHT, f"{what}: velocity")
    assert_close(Cr, golden[f"Cr_{suffix}"], TIGHT, f"{what}: Cr")
    assert_close(p[0], expected_p[0], TIGHT, f"{what}: orientation")
    assert_close(p[1:], expected_p[1:], TIGHT, f"{what}: semi-axes")
    assert_close(Cp, golden[f"Cp_{suffix}"], TIGHT, f"{what}: Cp")
    assert_close(Cp[0, 0], golden[f"Cp_{suffix}"][0][0], TIGHT, f"{what}: orientation variance")


def test_mem_ekf_star_cases() -> None:
    for number, case in enumerate(load("mem_ekf_star.json")["cases"]):
        start = (array(case[key]) for key in ("r_pred", "Cr_pred", "p_pred", "Cp_pred"))
        state = mem_ekf_star.update(*start, points(case["y"]), array(case["Ch"]), array(case["Cv"]))
        what = f"case {number} ({case['description']})"
        assert_mem_state(state, case, "upd", f"{what} updated")
        assert np.array_equal(case["Ap"], np.eye(3))
        state = mem_ekf_star.predict(*state, array(case["Ar"]), array(case["Cwr"]), array(case["Cwp"]))
        assert_mem_state(state, case, "next", f"{what} next")


def test_mem_ekf_star_sequences() -> None:
    for number, run in enumerate(load("mem_ekf_star.json")["sequences"]):
        Ar, Ch, Cv, Cwr, Cwp = (array(run[key]) for key in ("Ar", "Ch", "Cv", "Cwr", "Cwp"))
        assert np.array_equal(run["Ap"], np.eye(3))
        state = tuple(array(run[key]) for key in ("r0", "Cr0", "p0", "Cp0"))
        for scan, step in enumerate(run["steps"]):
            what = f"sequence {number}, scan {scan}"
            assert_mem_state(state, step, "pred", f"{what} predicted")
            state = mem_ekf_star.update(*state, points(step["y"]), Ch, Cv)
            assert_mem_state(state, step, "upd", f"{what} updated")
            state = mem_ekf_star.predict(*state, Ar, Cwr, Cwp)


def assert_feldmann_state(state: feldmann.State, golden: dict[str, Any], suffix: str, what: str) -> None:
    x, P, X, alpha = state
    expected_x = array(golden[f"x_{suffix}"])
    assert_close(x[:2], expected_x[:2], TIGHT, f"{what}: position")
    assert_close(x[2:], expected_x[2:], TIGHT, f"{what}: velocity")
    assert_close(P, golden[f"P_{suffix}"], TIGHT, f"{what}: P")
    assert_close(X, golden[f"X_{suffix}"], TIGHT, f"{what}: X")
    assert_close(alpha, golden[f"alpha_{suffix}"], TIGHT, f"{what}: alpha")


def test_feldmann_cases() -> None:
    for number, case in enumerate(load("feldmann_rm.json")["cases"]):
        start = (array(case["x_pred"]), array(case["P_pred"]), array(case["X_pred"]), case["alpha_pred"])
        state = feldmann.update(*start, points(case["y"]), array(case["R"]), case["z_scaling"])
        what = f"case {number} ({case['description']})"
        assert_feldmann_state(state, case, "upd", f"{what} updated")
        angle, semi_axes = feldmann.gottingen_read_out(state[2])
        assert_close(angle, case["angle_upd"], TIGHT, f"{what}: angle")
        assert_close(semi_axes, case["semi_axes_upd"], TIGHT, f"{what}: semi-axes")
        state = feldmann.predict(*state, array(case["F"]), array(case["Q"]), case["T"], case["tau"])
        assert_feldmann_state(state, case, "next", f"{what} next")


def test_feldmann_sequences() -> None:
    for number, run in enumerate(load("feldmann_rm.json")["sequences"]):
        F, Q, R = (array(run[key]) for key in ("F", "Q", "R"))
        state = (array(run["x0"]), array(run["P0"]), array(run["X0"]), run["alpha0"])
        for scan, step in enumerate(run["steps"]):
            if scan > 0:
                state = feldmann.predict(*state, F, Q, run["T"], run["tau"])
            what = f"sequence {number}, scan {scan}"
            assert_feldmann_state(state, step, "pred", f"{what} predicted")
            state = feldmann.update(*state, points(step["y"]), R, run["z_scaling"])
            assert_feldmann_state(state, step, "upd", f"{what} updated")


class GpFilter:
    """One predict-and-update call of the contour tracker with the settings of a golden entry."""

    def __init__(self, golden: dict[str, Any]) -> None:
        gp = golden["gp"]
        assert gp["mean"] == 0.0
        self.model = golden["model"]
        self.basis_angles = array(golden["basis_angles"])
        self.kernel = {key: gp[key] for key in ("std_prior", "std_radius", "length_scale")}
        self.std_meas = gp["std_meas"]
        self.K = gp_ett.kernel(self.basis_angles, self.basis_angles, **self.kernel)
        self.K_inv = gp_ett.kernel_inverse(self.K, golden["eps"])

    def __call__(self, x: ArrayLike, P: ArrayLike, y: ArrayLike) -> tuple[NDArray, NDArray]:
        x, P = gp_ett.predict(array(x), array(P), self.K, **self.model)
        gp = {**self.kernel, "std_meas": self.std_meas}
        return gp_ett.update(x, P, points(y), self.basis_angles, self.K_inv, **gp)


def assert_gp_mean(x: NDArray, expected: ArrayLike, what: str) -> None:
    expected = array(expected)
    assert_close(x[:2], expected[:2], GP_TOLERANCE, f"{what}: centre")
    assert_close(x[:6], expected[:6], GP_TOLERANCE, f"{what}: kinematics")
    assert_close(x[6:], expected[6:], GP_TOLERANCE, f"{what}: radii")


def test_gp_ett_cases() -> None:
    for number, case in enumerate(load("gp_ett.json")["cases"]):
        x, P = GpFilter(case)(case["x_prev"], case["P_prev"], case["y"])
        what = f"case {number}, {case['n_meas']} measurements"
        expected_P = array(case["P_upd"])
        assert_gp_mean(x, case["x_upd"], what)
        assert_close(P, expected_P, GP_TOLERANCE, f"{what}: P")
        assert_close(P[:6, :6], expected_P[:6, :6], GP_TOLERANCE, f"{what}: kinematic P")
        assert_close(P[6:, 6:], expected_P[6:, 6:], GP_TOLERANCE, f"{what}: P of the radii")
        assert_close(P[:6, 6:], expected_P[:6, 6:], GP_TOLERANCE, f"{what}: cross-covariance")


def test_gp_ett_sequences() -> None:
    for number, run in enumerate(load("gp_ett.json")["sequences"]):
        contour_filter = GpFilter(run)
        x, P = array(run["x0"]), array(run["P0"])
        for scan, step in enumerate(run["steps"]):
            x, P = contour_filter(x, P, step["y"])
            what = f"sequence {number}, scan {scan}"
            expected_diagonal = array(step["P_upd_diag"])
            assert_gp_mean(x, step["x_upd"], what)
            assert_close(np.diag(P)[:6], expected_diagonal[:6], GP_TOLERANCE, f"{what}: kinematic variances")
            assert_close(np.diag(P)[6:], expected_diagonal[6:], GP_TOLERANCE, f"{what}: radius variances")


def test_gaussian_wasserstein_pairs() -> None:
    for number, pair in enumerate(load("gaussian_wasserstein.json")["pairs"]):
        e1, e2 = array(pair["e1"]), array(pair["e2"])
        X1 = gaussian_wasserstein.extent_matrix(e1[4], e1[2:4])
        X2 = gaussian_wasserstein.extent_matrix(e2[4], e2[2:4])
        squared = gaussian_wasserstein.squared_distance(e1[:2], X1, e2[:2], X2)
        scale = np.sum((e1[:2] - e2[:2]) ** 2) + np.trace(X1) + np.trace(X2)
        assert abs(squared - pair["gw_squared"]) <= TIGHT * scale, f"pair {number} ({pair['kind']})"

"""The kinds of golden vectors that emt can run."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from emt.conformance.golden import (
    DEFAULT_TOLERANCE,
    Kind,
    Quantity,
    array,
    check_position_measurement,
    largest_scan,
    scan_of,
    time_step,
)
from emt.conformance.point_kinds import compare_ekf, compare_imm, compare_ukf, compare_vsimm
from emt.conformance.sampling_kinds import compare_lcd_samples, compare_s2kf_updates
from emt.conformance.shape_kinds import compare_ellipse_iou, compare_gaussian_wasserstein, compare_moment_update
from emt.filters import feldmann, gp_ett
from emt.filters import mem_ekf_star as mem
from emt.filters import vb_random_matrix as vb
from emt.filters.base import TrackingModel
from emt.filters.kinematics import Kinematics
from emt.linalg import Chol3, Sym2, Vec2
from emt.models.motion import FixedNoise, WhiteAcceleration
from emt.scans import scan_statistics
from emt.scenarios.recorded import RecordedSettings, read_scans
from emt.types import Scalar

NO_NOISE = FixedNoise.of(np.zeros((4, 4)))


def _model(sensor_noise, extent_scale: float, process_noise=None) -> TrackingModel:
    noise = NO_NOISE if process_noise is None else FixedNoise.of(np.asarray(process_noise, float)[:4, :4])
    return TrackingModel(noise, Sym2.of(array(sensor_noise)), jnp.asarray(extent_scale))


# --- variational random matrix ----------------------------------------------------------------------------------


def _vb_state(x, cov, shape, scale) -> vb.VbState:
    x, cov = array(x), array(cov)
    if np.any(np.asarray(cov)[4, :4]) or np.any(np.asarray(cov)[:4, 4]):
        raise ValueError("the predicted orientation must be uncorrelated with the kinematics")
    kinematics = Kinematics.of(x[:4], cov[:4, :4])
    return vb.VbState(kinematics, x[4], cov[4, 4], Vec2.of(array(shape)), Vec2.of(array(scale)))


def _vb_quantities(state: vb.VbState, expected: dict, suffix: str) -> Iterator[Quantity]:
    x, cov = array(expected[f"x{suffix}"]), array(expected[f"P{suffix}"])
    yield Quantity("position", state.kinematics.mean()[:2], x[:2])
    yield Quantity("velocity", state.kinematics.mean()[2:], x[2:4])
    yield Quantity("orientation", state.orientation, x[4])
    yield Quantity("kinematic covariance", state.kinematics.cov(), cov[:4, :4])
    yield Quantity("orientation variance", state.orientation_var, cov[4, 4])
    yield Quantity("inverse-gamma shapes", state.shape.array(), expected[f"alpha{suffix}"])
    yield Quantity("inverse-gamma scales", state.scale.array(), expected[f"beta{suffix}"])


_vb_update = partial(jax.jit, static_argnums=3)(vb.update)


def compare_vb(content: dict) -> Iterator[Quantity]:
    """Single updates and sequences of the variational random matrix."""
    capacity = largest_scan(content)
    for case in content["cases"]:
        check_position_measurement(case["H"])
        model = _model(case["R"], case["scaling_s"])
        state = _vb_state(case["x_pred"], case["P_pred"], case["alpha_pred"], case["beta_pred"])
        state = _vb_update(state, scan_of(case["y"], capacity), model, case["n_iterations"])
        yield from _vb_quantities(state, case, "_upd")
        yield Quantity("semi-axes", vb.semi_axes(state).array(), case["semi_axes_upd"])
    for sequence in content["sequences"]:
        check_position_measurement(sequence["H"])
        dt, noise = time_step(sequence["F"]), np.asarray(sequence["Q"], float)
        model = _model(sequence["R"], sequence["scaling_s"], noise)
        params = vb.Params((0.0, 0.0), 0.0, noise[4, 4], sequence["forgetting"])  # type: ignore[arg-type]
        state = _vb_state(sequence["x0"], sequence["P0"], sequence["alpha0"], sequence["beta0"])
        for k, step in enumerate(sequence["steps"]):
            state = vb.predict(state, jnp.asarray(dt), model, params) if k else state
            yield from _vb_quantities(state, step, "_pred")
            state = _vb_update(state, scan_of(step["y"], capacity), model, sequence["n_iterations"])
            yield from _vb_quantities(state, step, "_upd")


def compare_real_data_vb(content: dict, data: Path) -> Iterator[Quantity]:
    """The recorded sequence of a user's data file, tracked from the start."""
    given = content["parameters"]
    scans = read_scans(RecordedSettings(path=str(data), dt=float(given["T"])))
    capacity = max(len(scan) for scan in scans)
    model = TrackingModel(
        WhiteAcceleration(jnp.asarray(float(given["sigma_Q"]) ** 2)),
        Sym2.of(array(given["R"])),
        jnp.asarray(given["s"]),
    )
    params = vb.Params((0.0, 0.0), 0.0, given["Q_theta"], given["forgetting"])  # type: ignore[arg-type]
    state = _vb_state(given["x0"], np.diag(given["P0_diag"]), given["alpha0"], given["beta0"])
    frames = {frame["frame"]: frame for frame in content["frames"]}
    if max(frames) > len(scans):
        raise ValueError(f"the recording has {len(scans)} frames, the golden file {max(frames)}")
    for k in range(max(frames)):
        if k or given["time_update_before_first_frame"]:
            state = vb.predict(state, jnp.asarray(float(given["T"])), model, params)
        state = _vb_update(state, scan_of(scans[k], capacity), model, given["n_iterations"])
        if k + 1 in frames:
            frame = frames[k + 1]
            expected = {"x": frame["x"], "P": frame["P"], "alpha": frame["alpha"], "beta": frame["beta"]}
            yield from _vb_quantities(state, expected, "")
            yield Quantity("semi-axes", vb.semi_axes(state).array(), frame["semi_axes"])


# --- MEM-EKF* ---------------------------------------------------------------------------------------------------


def _mem_state(r, cov, p, shape_cov) -> mem.MemState:
    p = array(p)
    return mem.MemState(Kinematics.of(array(r), array(cov)), p[0], Vec2(p[1], p[2]), Chol3.of(array(shape_cov)))


def _mem_quantities(state: mem.MemState, expected: dict, suffix: str) -> Iterator[Quantity]:
    r, p = array(expected[f"r{suffix}"]), array(expected[f"p{suffix}"])
    yield Quantity("position", state.kinematics.mean()[:2], r[:2])
    yield Quantity("velocity", state.kinematics.mean()[2:], r[2:])
    yield Quantity("kinematic covariance", state.kinematics.cov(), expected[f"Cr{suffix}"])
    yield Quantity("orientation", state.orientation, p[0])
    yield Quantity("semi-axes", state.semi_axes.array(), p[1:])
    yield Quantity("shape covariance", state.shape_chol.array(), expected[f"Cp{suffix}"])


def _extent_scale(matrix) -> float:
    ch = np.asarray(matrix, float)
    if not np.array_equal(ch, ch[0, 0] * np.eye(2)):
        raise ValueError("only Ch = c I can be compared")
    return float(ch[0, 0])


_mem_update = jax.jit(mem.update)


def compare_mem_ekf_star(content: dict) -> Iterator[Quantity]:
    """Single updates with the time update after them, and sequences, of MEM-EKF*."""
    capacity = largest_scan(content)

    def predicted(state, given, model):
        check_position_measurement(given["H"])
        if not np.array_equal(np.asarray(given["Ap"]), np.eye(3)):
            raise ValueError("only a random walk of the shape (Ap = I) can be compared")
        params = mem.Params(array(given["Cwp"]), array(given["Cwp"]))
        return mem.predict(state, jnp.asarray(time_step(given["Ar"])), model, params)

    for case in content["cases"]:
        model = _model(case["Cv"], _extent_scale(case["Ch"]), case["Cwr"])
        state = _mem_state(case["r_pred"], case["Cr_pred"], case["p_pred"], case["Cp_pred"])
        state = _mem_update(state, scan_of(case["y"], capacity), model)
        yield from _mem_quantities(state, case, "_upd")
        yield from _mem_quantities(predicted(state, case, model), case, "_next")
    for sequence in content["sequences"]:
        model = _model(sequence["Cv"], _extent_scale(sequence["Ch"]), sequence["Cwr"])
        state = _mem_state(sequence["r0"], sequence["Cr0"], sequence["p0"], sequence["Cp0"])
        for k, step in enumerate(sequence["steps"]):
            state = predicted(state, sequence, model) if k else state
            yield from _mem_quantities(state, step, "_pred")
            state = _mem_update(state, scan_of(step["y"], capacity), model)
            yield from _mem_quantities(state, step, "_upd")


# --- Feldmann's random matrix -----------------------------------------------------------------------------------


def _rm_quantities(state: feldmann.FeldmannState, expected: dict, suffix: str) -> Iterator[Quantity]:
    x = array(expected[f"x{suffix}"])
    yield Quantity("position", state.kinematics.mean()[:2], x[:2])
    yield Quantity("velocity", state.kinematics.mean()[2:], x[2:])
    yield Quantity("kinematic covariance", state.kinematics.cov(), expected[f"P{suffix}"])
    yield Quantity("extent", state.extent.array(), expected[f"X{suffix}"])
    yield Quantity("weight", state.weight, expected[f"alpha{suffix}"])


@jax.jit
def _rm_update(state, scan, model):
    return feldmann.update(state, scan_statistics(scan), model)


def compare_feldmann(content: dict) -> Iterator[Quantity]:
    """Single updates with read-out and time update, and sequences, of the random matrix."""
    capacity = largest_scan(content)

    def predicted(state, given, model):
        dt = jnp.asarray(time_step(given["F"]))
        moved = feldmann.kinematics.predict(state.kinematics, model.noise(dt), dt)
        state = state._replace(kinematics=moved)
        return feldmann.forget(state, "time_constant", jnp.asarray(float(given["tau"])), jnp.asarray(float(given["T"])))

    for case in content["cases"]:
        check_position_measurement(case["H"])
        model = _model(case["R"], case["z_scaling"], case["Q"])
        state = feldmann.FeldmannState(
            Kinematics.of(array(case["x_pred"]), array(case["P_pred"])),
            Sym2.of(array(case["X_pred"])),
            array(case["alpha_pred"]),
        )
        state = _rm_update(state, scan_of(case["y"], capacity), model)
        yield from _rm_quantities(state, case, "_upd")
        ellipse = feldmann.first_quadrant_axis(state.extent)
        yield Quantity("read-out semi-axes", ellipse.semi_axes, case["semi_axes_upd"])
        yield Quantity("read-out orientation", ellipse.orientation, case["angle_upd"])
        yield from _rm_quantities(predicted(state, case, model), case, "_next")
    for sequence in content["sequences"]:
        check_position_measurement(sequence["H"])
        model = _model(sequence["R"], sequence["z_scaling"], sequence["Q"])
        state = feldmann.FeldmannState(
            Kinematics.of(array(sequence["x0"]), array(sequence["P0"])),
            Sym2.of(array(sequence["X0"])),
            array(sequence["alpha0"]),
        )
        for k, step in enumerate(sequence["steps"]):
            state = predicted(state, sequence, model) if k else state
            yield from _rm_quantities(state, step, "_pred")
            state = _rm_update(state, scan_of(step["y"], capacity), model)
            yield from _rm_quantities(state, step, "_upd")


# --- Gaussian-process contour -----------------------------------------------------------------------------------


@jax.jit
def _gp_step(state, scan, dt: Scalar, angles, model, params):
    gp = gp_ett.contour(angles, params)
    return gp_ett.update(gp_ett.predict(state, dt, gp, model, params), scan, gp, model, params)


def compare_gp_ett(content: dict) -> Iterator[Quantity]:
    """Steps (time update, then measurement update) of the Gaussian-process tracker."""
    capacity = largest_scan(content)

    def stepper(given):
        gp, motion = given["gp"], given["model"]
        if gp["mean"] != 0.0 or given["eps"] != gp_ett.JITTER:
            raise ValueError(f"only a zero mean radius and eps = {gp_ett.JITTER} can be compared")
        params = gp_ett.Params(
            *(
                array(value)
                for value in (
                    gp["std_prior"] ** 2,
                    gp["std_radius"] ** 2,
                    gp["length_scale"],
                    0.0,
                    0.0,
                    motion["std_psi"] ** 2,
                    motion["forgetting_alpha"],
                    0.0,
                )
            )
        )
        zero = array(0.0)
        noise = array(gp["std_meas"] ** 2)
        model = TrackingModel(WhiteAcceleration(array(motion["std_center"] ** 2)), Sym2(noise, zero, noise), zero)
        dt, angles = array(motion["T"]), array(given["basis_angles"])
        return lambda state, y: _gp_step(state, scan_of(y, capacity), dt, angles, model, params)

    def quantities(state, expected):
        x = array(expected["x_upd"])
        yield Quantity("centre", state.mean[:2], x[:2])
        yield Quantity("orientation", state.mean[2], x[2], scale=max(abs(float(x[2])), 1.0))
        yield Quantity("velocity", state.mean[3:5], x[3:5])
        yield Quantity("turn rate", state.mean[5], x[5], scale=max(abs(float(x[5])), 1.0))
        yield Quantity("radii", state.mean[6:], x[6:])

    for case in content["cases"]:
        state = stepper(case)(gp_ett.GpState(array(case["x_prev"]), array(case["P_prev"])), case["y"])
        yield from quantities(state, case)
        yield Quantity("covariance", state.cov, case["P_upd"])
    for sequence in content["sequences"]:
        step_once = stepper(sequence)
        state = gp_ett.GpState(array(sequence["x0"]), array(sequence["P0"]))
        for step in sequence["steps"]:
            state = step_once(state, step["y"])
            yield from quantities(state, step)
            yield Quantity("covariance", jnp.diagonal(state.cov), step["P_upd_diag"])


KINDS = {
    "vb_update": Kind(compare_vb, DEFAULT_TOLERANCE),
    "real_data_vb": Kind(compare_real_data_vb, 1e-7, needs_data=True),
    "mem_ekf_star": Kind(compare_mem_ekf_star, DEFAULT_TOLERANCE),
    "feldmann_rm": Kind(compare_feldmann, DEFAULT_TOLERANCE),
    "gp_ett": Kind(compare_gp_ett, 1e-6),
    "lcd_samples": Kind(compare_lcd_samples, 1e-10),
    "s2kf_updates": Kind(compare_s2kf_updates, 1e-10),
    "moment_update": Kind(compare_moment_update, 1e-12),
    "ellipse_iou": Kind(compare_ellipse_iou, 1e-6),
    "gaussian_wasserstein": Kind(compare_gaussian_wasserstein, DEFAULT_TOLERANCE),
    "ekf": Kind(compare_ekf, 1e-10),
    "ukf": Kind(compare_ukf, 1e-10),
    "imm": Kind(compare_imm, 1e-10),
    "vsimm": Kind(compare_vsimm, 1e-10),
}

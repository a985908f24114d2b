"""Experiments on points from the command line: a run, and what cannot be run."""

import json
import re
import sys

import pytest

from tests.cli.run_emt import emt

TEXT = """
title: A point that turns
monte_carlo: {runs: 6, chunk: 4, seed: 2}
scenario:
  kind: state_space
  dt: 1 s
  legs:
    - {steps: 4, mode: straight, motion: {kind: constant_velocity}}
    - {steps: 4, mode: left, motion: {kind: constant_turn, rate: 5 deg/s}}
  start: {mean: [0, 0, 100, 0]}
  measurement: {kind: position, noise_cov: {diagonal: [400, 400]}}
  detection_probability: 1.0
model:
  kind: state_space
  motions:
    straight: {kind: constant_velocity, noise: {kind: white_acceleration, psd: 0.1}}
    left: {kind: constant_turn, rate: 5 deg/s, noise: {kind: white_acceleration, psd: 0.5}}
    right: {kind: constant_turn, rate: -5 deg/s, noise: {kind: white_acceleration, psd: 0.5}}
  switching: {transition: [[0.9, 0.1, 0.0], [0.2, 0.7, 0.1], [0.3, 0.0, 0.7]]}
  start: {straight: 0.8, left: 0.1, right: 0.1}
  measurement: {kind: position, noise_cov: {diagonal: [400, 400]}}
  prior: {mean: [0, 0, 100, 0], cov: {diagonal: [400, 400, 25, 25]}}
start_with: predict
filters:
  kf: {kind: kalman, motion: straight}
  imm: {kind: multiple_model, method: imm}
  lms: {kind: likely_model_set, unlikely_below: 0.01, principal_above: 0.3, keep: 2, start: [straight, left]}
  mgs:
    kind: model_group_switching
    groups: {a: [straight, left], b: [straight, right]}
    activate_above: 0.4
    probability_bounds: [0.1, 10]
    likelihood_bounds: [0.1, 10]
metrics: [position_rmse, cid, active_models]
"""
FUNCTIONS = '''
"""Measurements and motions that can and cannot be used."""

import jax.numpy as jnp

number = 3.0


def place(state, time):
    return state[:2]


def everything(state, time):
    return state


def branching(state, time):
    return state[:2] if state[0] > 0.0 else -state[:2]


def pair(state, time):
    return state[0], state[1]


def broken(state, time):
    raise KeyError("no such entry")


def stay(state, time, dt):
    return state


def shrink(state, time, dt):
    return state[:3]
'''
CHAIN = "{transition: [[0.9, 0.1, 0.0], [0.2, 0.7, 0.1], [0.3, 0.0, 0.7]]}"
STRAIGHT = "straight: {kind: constant_velocity, noise: {kind: white_acceleration, psd: 0.1}}"
KF = "  kf: {kind: kalman, motion: straight}\n"
SEEN = "  measurement: {kind: position, noise_cov: {diagonal: [400, 400]}}\n  prior"
POLAR = "  measurement: {kind: range_bearing, range_std: 5, bearing_std: 0.01}\n  prior"


def seen_by(function: str, size: int = 2) -> str:
    """The measurement of the model by a function beside the file."""
    cov = ", ".join(["400"] * size)
    return f"  measurement: {{kind: function, function: 'point_functions:{function}', noise_cov: [{cov}]}}\n  prior"


def moved_by(function: str) -> str:
    """The first motion by a function beside the file."""
    given = f"function: 'point_functions:{function}', states: [x, y, vx, vy], noise_cov: [1, 1, 1, 1]"
    return f"straight: {{kind: function, {given}}}"


PROPOSAL = "  pf: {kind: particle, motion: straight, particles: 50, proposal: {kind: ekf}}\n"
MISTAKES = [
    # chains
    (CHAIN, "{transition: [[0.9, 0.2, 0.0], [0.2, 0.7, 0.1], [0.3, 0.0, 0.7]]}", "model",
     "switching.transition: row 0 (from 'straight') sums to 1.1, not 1"),
    (CHAIN, "{transition: [[0.9, 0.2, 0.3], [0.1, 0.7, 0.0], [0.0, 0.1, 0.7]]}", "model",
     "its columns sum to 1, its rows do not; give the transpose (row: from, column: to)"),
    (CHAIN, "{transition: [[0.9, 0.1], [0.2, 0.8]]}", "model",
     "expected 3 rows of 3 probabilities, one per straight, left, right"),
    (CHAIN, "{changes: {straight: {lft: 0.1}}}", "model", "unknown name 'lft' (did you mean 'left'?)"),
    (CHAIN, "{changes: {straigt: {left: 0.1}}}", "model", "unknown name 'straigt' (did you mean 'straight'?)"),
    (CHAIN, "{changes: {straight: {left: 0.7, right: 0.6}}}", "model", "sum to 1.3, more than 1"),
    (CHAIN, "{stay: 0.9, changes: {}}", "model.switching", "give one of stay, changes or transition"),
    (CHAIN, "{stay: 1.9}", "model.switching.stay", "must be at most 1, got 1.9"),
    ("{straight: 0.8, left: 0.1, right: 0.1}", "{straigth: 1.0}", "model",
     "start: unknown motion 'straigth' (did you mean 'straight'?)"),
    ("{straight: 0.8, left: 0.1, right: 0.1}", "{straight: 0.8}", "model",
     "start: the probabilities sum to 0.8, not 1"),
    # sets of filters
    ("start: [straight, left]}", "start: [straight, lef]}", "filters.lms.start",
     "unknown motion 'lef' (did you mean 'left'?)"),
    ("start: [straight, left]}", "start: [left, left]}", "filters.lms.start", "'left' is given twice"),
    ("method: imm}", "method: imm, motions: [straight, rigth]}", "filters.imm.motions",
     "unknown motion 'rigth' (did you mean 'right'?)"),
    ("method: imm}", "method: im}", "filters.imm.method", "(did you mean 'imm'?)"),
    ("method: imm}", "method: imm, floor: 0.1}", "filters.imm.floor", "goes with method: static"),
    ("b: [straight, right]", "b: [straight, rihgt]", "filters.mgs.groups.b",
     "unknown motion 'rihgt' (did you mean 'right'?)"),
    ("b: [straight, right]", "b: [straight, left]", "filters.mgs.groups", "no group holds right"),
    ("activate_above: 0.4", "activate_above: 0.4\n    start: c", "filters.mgs", "start: unknown group 'c'"),
    ("unlikely_below: 0.01, principal_above: 0.3", "unlikely_below: 0.4, principal_above: 0.3", "filters.lms",
     "unlikely_below must be less than principal_above, got 0.4 and 0.3"),
    ("likelihood_bounds: [0.1, 10]", "likelihood_bounds: [10, 0.1]", "filters.mgs",
     "likelihood_bounds: the first must be less than the second, got 10 and 0.1"),
    (KF, "  kf: {kind: kalman}\n", "filters.kf.motion", "is required, as the model has several: straight, left, right"),
    (KF, "  kf: {kind: kalman, motion: strait}\n", "filters.kf.motion",
     "unknown motion 'strait' (did you mean 'straight'?)"),
    (KF, "  kf: {kind: kalmann, motion: straight}\n", "filters.kf.kind", "(did you mean 'kalman'?)"),
    # numbers
    (KF, "  pf: {kind: particle, motion: straight, particles: 0}\n", "filters.pf.particles",
     "must be greater than 0, got 0"),
    (KF, PROPOSAL.replace("{kind: ekf}", "{kind: ekf, noise_cov: [1, 1, 1]}"), "filters.pf.proposal",
     "noise_cov: expected 2 rows of 2 numbers"),
    (KF, "  ukf: {kind: ukf, motion: straight, kappa: -4}\n", "filters.ukf.kappa", "must be greater than -4"),
    ("psd: 0.1}", "psd: -0.1}", "model.motions.straight.noise.psd", "must be at least 0, got -0.1"),
    (SEEN, SEEN.replace("[400, 400]", "[-400, 400]"), "model.measurement.noise_cov",
     "variance [0][0] must be greater than 0, got -400"),
    (SEEN, SEEN.replace("[400, 400]", "[400, 0]"), "model.measurement.noise_cov",
     "variance [1][1] must be greater than 0, got 0"),
    (SEEN, POLAR.replace("range_std: 5", "range_std: 0"), "model.measurement.range_std",
     "must be greater than 0, got 0"),
    (SEEN, POLAR.replace("bearing_std: 0.01", "bearing_std: 1 m"), "model.measurement.bearing_std",
     "'1 m' is not an angle"),
    ("mean: [0, 0, 100, 0], cov", "mean: [0, 0, 100], cov", "model.prior", "expected 4 numbers, got 3"),
    ("mean: [0, 0, 100, 0], cov", "mean: [10 kg, 0, 100, 0], cov", "model.prior", "'10 kg' is not a length"),
    ("cov: {diagonal: [400, 400, 25, 25]}", "cov: {diagonal: [400, 0, 25, 25]}", "model.prior",
     "variance [1][1] must be greater than 0"),
    ("start: {mean: [0, 0, 100, 0]}", "start: {mean: [0, 0, 100, 0, 0]}", "scenario.start",
     "expected 4 numbers, got 5"),
    ("rate: 5 deg/s}}", "rate: 5 m/s}}", "scenario.legs[1].motion.rate", "'5 m/s' is not"),
    # what does not fit together
    ("  start: {mean: [0, 0, 100, 0]}", "  steps: 3\n  start: {mean: [0, 0, 100, 0]}", "scenario",
     "steps: the legs have their own"),
    ("  start: {mean: [0, 0, 100, 0]}", "  motion: {kind: constant_velocity}\n  start: {mean: [0, 0, 100, 0]}",
     "scenario", "give one of motion, legs or motions"),
    ("mode: left", "mode: lefft", "scenario.legs[1].mode", "unknown motion 'lefft' (did you mean 'left'?)"),
    ("mode: left, ", "", "scenario", "legs: give the mode of all or of none"),
    (SEEN, POLAR, "filters.kf.kind", "needs a linear model, and measurement 'range_bearing' is not; use ekf or ukf"),
    (KF, PROPOSAL.replace("straight", "stiff"), "filters.pf.motion", "unknown motion 'stiff'"),
    ("metrics: [position_rmse,", "metrics: [gw,", "metrics[0]", "no filter of this experiment has 'gw'"),
    (KF, "  vb: {kind: feldmann, weight: 9, decay: {kind: weight, factor: 0.9}}\n", "filters.vb.kind",
     "'feldmann' is about an ellipse, the model about a point"),
    ("metrics:", "divergence: {final_iou_below: 0.5}\nmetrics:", "divergence.final_iou_below",
     "IoU is that of an ellipse"),
    # functions beside the file
    (SEEN, seen_by("everything"), "model",
     "measurement: the measurement function returns shape (4,), expected (2,)"),
    (SEEN, seen_by("everything", 3), "model", "returns shape (4,), expected (3,)"),
    (SEEN, seen_by("pair"), "model", "returns shape tuple, expected (2,)"),
    (SEEN, seen_by("broken"), "model", "cannot be traced by JAX: KeyError: 'no such entry'"),
    (SEEN, seen_by("branching"), "model", "cannot be traced by JAX: TracerBoolConversionError"),
    (SEEN, seen_by("plce"), "model.measurement.function", "point_functions:plce"),
    (SEEN, seen_by("number"), "model.measurement.function", "is a float, not a function"),
    (SEEN, seen_by("place").replace("point_functions:", "no_such_module:"), "model.measurement.function",
     "No module named 'no_such_module'"),
    (SEEN, seen_by("place").replace("point_functions:place", "place"), "model.measurement.function",
     "expected 'module:function', got 'place'"),
    (STRAIGHT, moved_by("shrink"), "model", "motions.straight: the motion function returns shape (3,), expected (4,)"),
    (STRAIGHT, moved_by("stay").replace("vy]", "w]"), "model",
     "motions.left: its state is x, y, vx, vy, not x, y, vx, w"),
    (STRAIGHT, moved_by("stay").replace("vy]", "vx]"), "model", "states: 'vx' is given twice"),
]  # fmt: skip


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where a user keeps experiment and functions."""
    (tmp_path / "point_functions.py").write_text(FUNCTIONS, encoding="utf-8")
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    sys.modules.pop("point_functions", None)


def write(folder, text: str = TEXT):
    path = folder / "point.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def assert_refused(outcome, config, key: str, message: str, out) -> None:
    """Exit 2 with file, line, key and message on one line; nothing else happened."""
    assert outcome.code == 2
    assert "Traceback" not in outcome.err
    assert not out.exists()
    found = [line for line in outcome.err.splitlines() if message in line]
    assert found, outcome.err
    place = re.match(rf"(?:\w+: )?{re.escape(str(config))}:(\d+): ([^ ]+): ", found[0])
    assert place, found[0]
    assert 1 <= int(place[1]) <= len(config.read_text(encoding="utf-8").splitlines())
    assert place[2].startswith(key), found[0]


@pytest.mark.parametrize(("right", "wrong", "key", "message"), MISTAKES, ids=[f"{m[2]}: {m[3][:40]}" for m in MISTAKES])
def test_a_mistake_is_named_with_its_line_and_key(folder, capsys, right, wrong, key, message):
    assert right in TEXT
    config = write(folder, TEXT.replace(right, wrong, 1))
    outcome = emt(capsys, "run", config, "--out", folder / "out")
    assert_refused(outcome, config, key, message, folder / "out")


def test_lines_are_those_of_the_mistakes(folder, capsys):
    """Two mistakes at once, each with its own line."""
    text = TEXT.replace("mode: left", "mode: lefft").replace("b: [straight, right]", "b: [straight, rihgt]")
    config = write(folder, text)
    outcome = emt(capsys, "run", config, "--out", folder / "out")
    lines = text.splitlines()
    for word, key in (("lefft", "scenario.legs[1].mode"), ("rihgt", "filters.mgs.groups.b")):
        number = next(k for k, line in enumerate(lines, 1) if word in line)
        assert f"{config}:{number}: {key}: " in outcome.err


def test_a_gaussian_proposal_needs_noise_of_full_rank(folder, capsys):
    """A piecewise acceleration has two degrees of freedom; the bootstrap filter takes it."""
    noise = "noise: {kind: piecewise_acceleration, variance: 0.1}"
    text = TEXT.replace("noise: {kind: white_acceleration, psd: 0.1}", noise)
    config = write(folder, text.replace(KF, PROPOSAL))
    outcome = emt(capsys, "run", config, "--out", folder / "out")
    message = "needs process noise of full rank to weigh particles, and that of 'straight' has rank 2 of 4"
    assert_refused(outcome, config, "filters.pf.proposal", message, folder / "out")
    assert "use white_acceleration, or proposal: {kind: prior}" in outcome.err
    config = write(folder, text.replace(KF, PROPOSAL.replace("{kind: ekf}", "{kind: prior}")))
    assert emt(capsys, "show", config).code == 0


def test_identification_needs_a_scenario_that_tells_the_mode(folder, capsys):
    text = TEXT.replace("mode: straight, ", "").replace("mode: left, ", "")
    config = write(folder, text)
    outcome = emt(capsys, "run", config, "--out", folder / "out")
    assert_refused(outcome, config, "metrics[1]", "mode", folder / "out")
    assert "'cid'" in outcome.err


def test_scenario_and_model_have_the_same_state_and_measurement(folder, capsys):
    growth = """
title: Growth
monte_carlo: {runs: 4}
scenario:
  kind: state_space
  steps: 3
  motion: {kind: growth}
  start: {mean: [1]}
  measurement: {kind: growth, variance: 1}
model:
  kind: state_space
  motion: {kind: constant_velocity, noise: {kind: white_acceleration, psd: 0.1}}
  measurement: {kind: position, noise_cov: [1, 1]}
  prior: {mean: [0, 0, 1, 0], cov: [1, 1, 1, 1]}
filters: {kf: {kind: kalman}}
metrics: [run_rmse]
"""
    config = write(folder, growth)
    outcome = emt(capsys, "run", config, "--out", folder / "out")
    message = "the state is level, that of the model x, y, vx, vy"
    assert_refused(outcome, config, "scenario.start", message, folder / "out")
    sizes = TEXT.replace(SEEN, "  measurement: {kind: linear, matrix: [[1, 0, 0, 0]], noise_cov: [400]}\n  prior")
    config = write(folder, sizes)
    outcome = emt(capsys, "run", config, "--out", folder / "out")
    message = "a measurement has 2 numbers, that of the model 1"
    assert_refused(outcome, config, "scenario.measurement", message, folder / "out")


def test_a_filter_of_points_does_not_take_an_ellipse(folder, capsys):
    ellipse = """
title: Ellipse
scenario:
  kind: stationary
  steps: 4
  semi_axes: [10, 4]
  detections: {count: {kind: fixed, count: 5}, source: uniform, noise_cov: [[1, 0], [0, 1]]}
model:
  process_noise: {kind: white_acceleration, psd: 0.01}
  noise_cov: [[1, 0], [0, 1]]
  extent_scale: 0.25
  prior: {mean: [0, 0, 0, 0], cov: [1, 1, 1, 1], semi_axes: [8, 5]}
filters:
  bank: {kind: multiple_model, method: imm}
"""
    config = write(folder, ellipse)
    outcome = emt(capsys, "run", config, "--out", folder / "out")
    message = "'multiple_model' is about a point (state_space), the model about an ellipse"
    assert_refused(outcome, config, "filters.bank.kind", message, folder / "out")


def test_a_bank_needs_several_motions_and_their_chain(folder, capsys):
    config = write(folder, TEXT.replace(f"  switching: {CHAIN}\n", ""))
    outcome = emt(capsys, "run", config, "--out", folder / "out")
    message = "needs model.switching, the chain over the motions"
    assert_refused(outcome, config, "filters.imm.kind", message, folder / "out")
    assert "filters.lms.kind" in outcome.err
    assert "filters.mgs.kind" in outcome.err


def test_a_motion_that_cannot_be_reached_is_only_warned_of(folder, capsys):
    """The experiment is used as it is; the line of the motion is named."""
    chain = "{transition: [[0.9, 0.1, 0.0], [0.2, 0.8, 0.0], [0.3, 0.0, 0.7]]}"
    start = "{straight: 0.8, left: 0.1, right: 0.1}"
    text = TEXT.replace(CHAIN, chain).replace(start, "{straight: 1.0}")
    config = write(folder, text)
    number = next(k for k, line in enumerate(text.splitlines(), 1) if line.startswith("    right:"))
    outcome = emt(capsys, "show", config)
    assert outcome.code == 0
    assert f"warning: {config}:{number}: model.motions.right: cannot be reached" in outcome.err
    assert outcome.err.count("warning:") == 1
    assert "straight" in outcome.out
    fine = emt(capsys, "show", write(folder, text.replace("{straight: 1.0}", start)))
    assert fine.code == 0
    assert "warning" not in fine.err


def test_a_run_and_its_summary(folder, capsys):
    """Filters have the metrics that they can have."""
    text = re.sub(r"  lms: .*\n|  mgs:\n(    .*\n)+", "", TEXT)
    outcome = emt(capsys, "run", write(folder, text), "--out", folder / "out")
    assert outcome.code == 0, outcome.err
    summary = json.loads((folder / "out" / "summary.json").read_text(encoding="utf-8"))
    assert summary["runs"] == 6
    assert set(summary["filters"]) == {"kf", "imm"}
    assert set(summary["filters"]["kf"]) == {"position_rmse"}
    found = summary["filters"]["imm"]
    assert found["position_rmse"]["value"] < 30.0
    assert 0.0 <= found["cid"]["value"] <= 1.0
    assert found["active_models"]["value"] == 3.0
    assert summary["status"]["imm"]["failed"] == 0

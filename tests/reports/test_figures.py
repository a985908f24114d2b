"""Figures: sound bytes for every kind of run, and the numbers behind the pictures."""

import subprocess
import sys
import warnings

import numpy as np
import pytest

from emt.reports.ellipse_art import (
    ellipse_outline,
    neighbours,
    scene_of,
    shown_steps,
    star_outline,
    zoom_steps,
)
from emt.reports.figures import over_time_figure, replay_figure, track_figure
from emt.reports.plot_style import line_style
from emt.reports.series_art import bands, chosen_metrics, failure_note, run_series
from emt.reports.summary import Curve
from emt.status import Status

METRICS = [
    {"name": "nees", "unit": "1", "over_time": "mean", "over_runs": "mean", "definition": "", "without": []},
    {"name": "position_rmse", "unit": "L", "over_time": "rms", "over_runs": "rms", "definition": "", "without": []},
    {"name": "gw", "unit": "L", "over_time": "mean", "over_runs": "mean", "definition": "", "without": []},
    {"name": "gw_std", "unit": "L", "over_time": "mean", "over_runs": "std", "definition": "", "without": []},
    {"name": "iou", "unit": "1", "over_time": "mean", "over_runs": "mean", "definition": "", "without": []},
]
RIVALS = ["vb", "mem_ekf_star", "feldmann", "gp_ett", "a", "b", "c", "d"]


@pytest.fixture(autouse=True)
def _warnings_are_errors():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def make_arrays(labels=("vb", "mem_ekf_star"), n_steps=60, truth=True, runs=2):
    """Tracks of an object of 10 by 4 m that drives straight, turns by a right angle and drives on."""
    rng = np.random.default_rng(5)
    heading = np.pi / 2 * np.clip((np.arange(n_steps) - n_steps // 3) / max(n_steps // 3, 1), 0.0, 1.0)
    path = np.cumsum(4.0 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    shape = (runs, n_steps)
    points = path[None, :, None, :] + rng.normal(0.0, 2.0, (*shape, 12, 2))
    arrays = {"scans/points": points, "scans/mask": rng.random((*shape, 12)) < 0.7}
    if truth:
        arrays |= {
            "truth/position": np.broadcast_to(path, (*shape, 2)),
            "truth/semi_axes": np.broadcast_to([5.0, 2.0], (*shape, 2)),
            "truth/orientation": np.broadcast_to(heading, shape),
        }
    for label in labels:
        arrays |= {
            f"{label}/track/center": path + rng.normal(0.0, 0.4, (*shape, 2)),
            f"{label}/track/semi_axes": np.array([5.0, 2.0]) * np.exp(rng.normal(0.0, 0.1, (*shape, 2))),
            f"{label}/track/orientation": heading + rng.normal(0.0, 0.1, shape),
            f"{label}/track/per_step": rng.random((*shape, len(METRICS))),
            f"{label}/track/nis": rng.chisquare(2.0, shape),
            f"{label}/track/status": np.zeros(shape, np.int32),
        }
    return arrays


def make_curves(labels=("vb", "mem_ekf_star"), n_steps=40, runs=100):
    rng = np.random.default_rng(6)
    return {
        label: {m["name"]: Curve(1.0 + rng.random(n_steps), rng.random(n_steps), runs) for m in METRICS}
        for label in labels
    }


def assert_png(data):
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    assert 5_000 < len(data) < 200 * 1024
    assert b"Software" not in data
    assert b"tIME" not in data


@pytest.mark.parametrize(
    ("truth", "n_steps", "labels"),
    [
        (True, 60, ["vb"]),
        (True, 60, RIVALS),
        (False, 60, RIVALS),
        (True, 1, RIVALS),
        (False, 1, ["vb"]),
        (False, 2, ["vb"]),
    ],
)
def test_tracks_of_every_kind_of_run(truth, n_steps, labels):
    arrays = make_arrays(labels, n_steps, truth)
    assert_png(track_figure(arrays, labels, run_index=1, title="run 1"))
    assert_png(replay_figure(arrays, labels, METRICS, run_index=1))


@pytest.mark.parametrize(("n_steps", "labels"), [(1, RIVALS), (40, ["vb"]), (40, RIVALS)])
def test_curves_of_every_number_of_filters(n_steps, labels):
    assert_png(over_time_figure(make_curves(labels, n_steps), METRICS, "m"))


def test_the_same_input_gives_the_same_bytes():
    arrays, labels = make_arrays(n_steps=12), ["vb", "mem_ekf_star"]
    assert track_figure(arrays, labels) == track_figure(arrays, labels)
    assert replay_figure(arrays, labels, METRICS) == replay_figure(arrays, labels, METRICS)
    assert over_time_figure(make_curves(), METRICS, "m") == over_time_figure(make_curves(), METRICS, "m")


def test_the_readers_own_settings_change_nothing():
    import matplotlib

    arrays = make_arrays(["vb"], 1)
    expected = track_figure(arrays, ["vb"])
    with matplotlib.rc_context({"font.size": 20.0, "axes.facecolor": "black", "savefig.dpi": 30}):
        assert track_figure(arrays, ["vb"]) == expected


@pytest.mark.parametrize("title", ["a_b $x_{", r"\frac $^$ 1 $"])
def test_titles_are_not_formulas(title):
    labels = ["a_b$", "c^$d$"]
    arrays = make_arrays(labels, 1)
    assert_png(track_figure(arrays, labels, title=title, length_unit="$"))
    assert_png(replay_figure(arrays, labels, METRICS, title=title, dt_label=title))
    assert_png(over_time_figure(make_curves(labels), METRICS[:1], "$_", title=title, dt_label=title))


def test_a_lost_filter_does_not_spoil_the_picture():
    arrays, labels = make_arrays(), ["vb", "mem_ekf_star"]
    for name, value in (("center", np.nan), ("semi_axes", np.inf)):
        arrays[f"vb/track/{name}"][:, 20:] = value
    arrays["mem_ekf_star/track/center"][:, 30:] = 1e12
    arrays["vb/track/status"][:, 20:] = int(Status.NON_FINITE)
    arrays["mem_ekf_star/track/status"][:, 30:] = int(Status.DIVERGED)
    assert_png(track_figure(arrays, labels))
    assert_png(replay_figure(arrays, labels, METRICS))
    assert failure_note(arrays, "vb", 0) == "vb: non-finite at 40 scans, first at scan 21"
    scores = run_series(arrays, labels, METRICS, 0, "m", 4)[0].values
    assert np.isfinite(scores["vb"][:20]).all()
    assert np.isnan(scores["vb"][20:]).all()
    assert np.isfinite(scores["mem_ekf_star"]).all()


def test_empty_scans_leave_no_hole():
    arrays = make_arrays(truth=False)
    arrays["scans/mask"][:, 10:20] = False
    assert np.isfinite(scene_of(arrays, ["vb"], 0).path).all()
    arrays["scans/mask"][:] = False
    assert_png(track_figure(arrays, ["vb"]))


def test_runs_that_all_failed_leave_their_curve_out():
    curves = make_curves()
    curves["vb"] = {name: Curve(0.0 * c.mean, 0.0 * c.std, 0) for name, c in curves["vb"].items()}
    assert_png(over_time_figure(curves, METRICS, "m"))
    assert_png(over_time_figure({"vb": curves["vb"], "reference": {}}, METRICS[:2], "m"))


def test_no_metrics_show_the_shape_instead():
    arrays = make_arrays(["vb"], truth=False)
    arrays["vb/track/per_step"] = np.zeros((2, 60, 0))
    names = [series.name for series in run_series(arrays, ["vb"], [], 0, "px", 4)]
    assert names == ["longer semi-axis", "shorter semi-axis", "normalised innovation squared"]
    assert_png(replay_figure(arrays, ["vb"], [], length_unit="px"))


def test_a_reference_filter_has_no_scores():
    arrays = make_arrays()
    arrays["vb/track/per_step"] = np.zeros((2, 60, 0))
    others = [metric | {"without": ["vb"]} for metric in METRICS]
    assert list(run_series(arrays, ["vb", "mem_ekf_star"], others, 0, "m", 4)[0].values) == ["mem_ekf_star"]


def test_telling_metrics_come_first():
    assert [m["name"] for m in chosen_metrics(METRICS, 3)] == ["gw", "iou", "position_rmse"]
    assert "gw_std" not in [m["name"] for m in chosen_metrics(METRICS, 9)]


def test_interval_of_a_mean_and_of_a_root():
    curve = Curve(np.array([4.0]), np.array([10.0]), 100)
    inner, outer = bands(curve, is_root=False)
    np.testing.assert_allclose(inner[:, 0], [4.0, 2.04, 5.96])
    assert outer is not None
    np.testing.assert_allclose(outer[:, 0], [-6.0, 14.0])
    inner, outer = bands(curve, is_root=True)
    np.testing.assert_allclose(inner[:, 0], np.sqrt([4.0, 2.04, 5.96]))
    assert outer is None


def test_a_star_that_is_an_ellipse_is_drawn_as_one():
    n, a, b, body, center = 360, 5.0, 2.0, 0.7, np.array([[3.0, -1.0]])
    angles = np.arange(n) * (2.0 * np.pi / n)
    radii = a * b / np.hypot(b * np.cos(angles), a * np.sin(angles))
    star = star_outline(center, np.array([body]), radii[None])[0] - center
    c, s = np.cos(body), np.sin(body)
    u, v = star @ np.array([c, s]), star @ np.array([-s, c])
    np.testing.assert_allclose((u / a) ** 2 + (v / b) ** 2, 1.0, atol=1e-9)
    ellipse = ellipse_outline(center, np.array([[a, b]]), np.array([body]))[0] - center
    np.testing.assert_allclose(ellipse.max(axis=0), star.max(axis=0), atol=2e-2)


def test_a_lopsided_star_keeps_its_body_frame():
    """A disc of radius 2 about (0.5, 0) of the body: its centroid is there, and its outline is that disc."""
    angles = np.arange(720) * (2.0 * np.pi / 720)
    radii = 0.5 * np.cos(angles) + np.sqrt(4.0 - (0.5 * np.sin(angles)) ** 2)
    star = star_outline(np.array([[10.0, 20.0]]), np.array([0.3]), radii[None])[0]
    np.testing.assert_allclose(np.hypot(*(star - [10.0, 20.0]).T), 2.0, atol=1e-4)


def test_drawn_outlines_do_not_overlap_and_closeups_lie_in_the_turn():
    scene = scene_of(make_arrays(), ["vb"], 0)
    steps = shown_steps(scene)
    assert 6 <= len(steps) <= 22
    assert (np.hypot(*np.diff(scene.path[steps], axis=0).T) > scene.length).all()
    middles = zoom_steps(scene, steps)
    assert 20 <= middles[0] <= 40
    for k in middles:
        assert k in neighbours(scene, int(k))


def test_a_standing_object_is_drawn_a_few_times():
    arrays = make_arrays()
    arrays["truth/position"] = np.zeros((2, 60, 2))
    assert len(shown_steps(scene_of(arrays, ["vb"], 0))) == 3
    assert_png(track_figure(arrays, ["vb"]))


def test_forty_filters_look_different():
    assert len({str(line_style(k)) for k in range(40)}) == 40


def test_figures_need_neither_jax_nor_pyplot():
    code = "import sys, emt.reports.figures; sys.exit(bool({'jax', 'matplotlib.pyplot'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

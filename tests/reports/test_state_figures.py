"""Figures of experiments on points: paths, states over time, mode probabilities and chi-square bands."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

from emt.models.state_space.measurements import RangeBearing
from emt.montecarlo.chunks import scan_places, score_arrays, without_tracks
from emt.montecarlo.run import Scores, Track, mode_names, report
from emt.reports.axis_art import needs_log
from emt.reports.connected_art import is_connected
from emt.reports.figures import over_time_figure, replay_figure, track_figure
from emt.reports.modes_art import modes_figure, true_steps
from emt.reports.plot_style import fixed_look, new_figure, styles_of
from emt.reports.series_art import bands, chosen_metrics, draw_band, draw_curves
from emt.reports.state_art import close_ups, draw_flight, flight_of, flight_size, flight_window, is_state_space
from emt.reports.summary import Curve, band, mode_shares
from emt.status import Status
from emt.store import RunFolder, read_folder
from emt.types import Estimate, Filter, Info, Measurements, Point, StatePrior
from tests.reports.test_figures import assert_png
from tests.store.unreliable import make_manifest

STATE = ("x", "y", "vx", "vy")
LABELS = ("kf", "imm")
NEES = {"name": "nees", "unit": "1", "over_time": "mean", "over_runs": "mean", "without": [], "dof": 4}
METRICS = [
    {"name": "position_rmse", "unit": "L", "over_time": "rms", "over_runs": "pooled", "without": []},
    NEES,
    {"name": "cid", "unit": "1", "over_time": "mean", "over_runs": "mean", "without": ["kf"]},
]


@pytest.fixture(autouse=True)
def _warnings_are_errors():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def make_arrays(n_steps=60, n=4, labels=LABELS):
    """A point that drives straight at 100 m per step and then turns, with errors of a few metres."""
    rng = np.random.default_rng(1)
    heading = np.clip(0.05 * (np.arange(n_steps) - n_steps // 2), 0.0, None)
    velocity = 100.0 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    truth = np.concatenate([np.cumsum(velocity, axis=0), velocity], axis=1)[None, :, :n]
    arrays = {
        "truth/state": truth,
        "truth/mode": (heading > 0.0)[None].astype(int),
        "scans/points": truth[..., None, :2] + rng.normal(0.0, 10.0, (1, n_steps, 1, min(n, 2))),
        "scans/mask": np.ones((1, n_steps, 1), bool),
    }
    if n >= 2:
        arrays["scans/places"] = arrays["scans/points"][:, :, 0]
    for k, label in enumerate(labels):
        arrays |= {
            f"{label}/track/mean": truth + rng.normal(0.0, 5.0 + k, truth.shape),
            f"{label}/track/per_step": rng.random((1, n_steps, len(METRICS))),
            f"{label}/track/nis": rng.chisquare(2.0, (1, n_steps)),
            f"{label}/track/status": np.zeros((1, n_steps), np.int32),
        }
    return arrays


def track(arrays, **changed):
    return track_figure(arrays, LABELS, **({"state": STATE, "maneuvers": [(31, 60)], "title": "run 0"} | changed))


def test_a_path_in_the_plane():
    arrays = make_arrays()
    picture = track(arrays)
    assert_png(picture)
    assert track(make_arrays()) == picture
    assert track(arrays, maneuvers=()) != picture
    arrays["imm/track/mean"] = arrays["imm/track/mean"] + 50.0
    assert track(arrays) != picture
    assert_png(replay_figure(arrays, LABELS, METRICS, state=STATE, maneuvers=[(31, 60)]))


@pytest.mark.parametrize("n_steps", [1, 2, 5])
def test_short_runs(n_steps):
    arrays = make_arrays(n_steps)
    assert_png(track(arrays, maneuvers=()))
    arrays["scans/places"][:] = np.nan
    assert_png(track(arrays, maneuvers=()))


def test_states_without_a_plane_are_shown_over_time():
    arrays = make_arrays(n=1)
    assert_png(track(arrays, state=("level",), maneuvers=()))
    assert_png(replay_figure(arrays, LABELS, METRICS, state=("level",)))
    arrays = make_arrays()
    flight = flight_of(arrays, LABELS, 0, ("a", "b", "c", "d"))
    figure = new_figure(*flight_size(flight))
    draw_flight(figure, flight, styles_of(LABELS), "m", {})
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["a", "b", "c", "d"]
    many = {"truth/state": np.tile(arrays["truth/state"], 2)} | {
        f"{label}/track/mean": np.tile(arrays[f"{label}/track/mean"], 2) for label in LABELS
    }
    flight = flight_of(many, LABELS, 0, ())
    figure = new_figure(*flight_size(flight))
    draw_flight(figure, flight, styles_of(LABELS), "m", {})
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["entry 1", "entry 2", "entry 3", "entry 4"]


def test_a_filter_that_is_far_off_does_not_spoil_the_scale():
    arrays = make_arrays()
    before = flight_window(flight_of(arrays, LABELS, 0, STATE))
    arrays["kf/track/mean"][:, 20:] += 1e5
    arrays["kf/track/mean"][:, 30:] = 1e200
    arrays["kf/track/mean"][:, 40:] = np.nan
    arrays["kf/track/status"][:, 40:] = int(Status.NON_FINITE)
    flight = flight_of(arrays, LABELS, 0, STATE)
    assert flight_window(flight) == before
    assert before.width < 1.2 * np.ptp(arrays["truth/state"][0, :, 0])
    assert_png(track(arrays))
    assert_png(replay_figure(arrays, LABELS, METRICS, state=STATE))
    assert_png(track(arrays, state=("a", "b", "c", "d")))


def test_close_ups_are_where_filters_differ():
    arrays = make_arrays()
    arrays["imm/track/mean"][0, 40, :2] += 30.0
    flight = flight_of(arrays, LABELS, 0, STATE)
    found = close_ups(flight, flight_window(flight))
    assert 40 in [detail.step for detail in found]
    for detail in found:
        x, y = flight.path[detail.step]
        assert detail.box.x0 < x < detail.box.x1
        assert detail.box.y0 < y < detail.box.y1
    rough = {label: mean + 500.0 for label, mean in flight.filters.items()}
    assert close_ups(flight._replace(filters=rough), flight_window(flight)) == []


def test_points_and_connected_objects_are_told_apart():
    arrays = make_arrays()
    assert is_state_space(arrays)
    assert not is_connected(arrays)
    for name in ("starts", "bodies", "discs"):
        connected = arrays | {f"truth/{name}": np.zeros((1, 60, 1, 2))}
        assert is_connected(connected)
        assert not is_state_space(connected)
    ellipse = {"truth/position": np.zeros((1, 60, 2))}
    assert not is_connected(ellipse)
    assert not is_state_space(ellipse)


def make_shares(count=2, n_steps=40):
    rng = np.random.default_rng(2)
    names = ["m1", "m2", "m10"]
    return {f"imm{k}": (names, rng.dirichlet(np.ones(3), n_steps).T) for k in range(count)}


def test_mode_probabilities():
    shares, modes = make_shares(), ["m1"] * 20 + ["m10"] * 20
    picture = modes_figure(shares, modes, "modes")
    assert_png(picture)
    assert modes_figure(make_shares(), modes, "modes") == picture
    assert modes_figure(shares, None, "modes") != picture
    assert modes_figure(shares | {"imm1": shares["imm0"]}, modes, "modes") != picture
    assert_png(modes_figure(make_shares(6), None))
    assert modes_figure(make_shares(8), modes) == modes_figure(make_shares(6), modes)
    tall = {label: ([f"m{k}" for k in range(13)], np.full((13, 40), 1 / 13)) for label in "abcde"}
    assert_png(modes_figure(tall, ["m3"] * 40))


def test_the_line_of_the_true_mode_has_gaps_where_a_filter_lacks_it():
    scans, places = true_steps(["a", "b"], ["b", "c", "a"])
    np.testing.assert_array_equal(scans, [0.5, 1.5, 1.5, 2.5, 2.5, 3.5])
    np.testing.assert_array_equal(places, [1, 1, np.nan, np.nan, 0, 0])


def make_curves(n_steps=30, runs=50, **level):
    rng = np.random.default_rng(3)
    return {
        label: {
            m["name"]: Curve(mean * (1.0 + 0.1 * rng.random(n_steps)), np.full(n_steps, mean), runs) for m in METRICS
        }
        for label, mean in level.items()
    }


def test_bands_of_consistent_filters():
    with fixed_look():
        ax = new_figure(4.0, 3.0).subplots()
        ends = draw_band(ax, NEES, 50)
        np.testing.assert_allclose(ends, band(4, 50))
        drawn = ax.patches[0].get_extents().transformed(ax.transData.inverted())
        np.testing.assert_allclose([drawn.y0, drawn.y1], ends)
        np.testing.assert_array_equal(ax.lines[0].get_ydata(), [4, 4])
        assert len(draw_band(ax, METRICS[0] | {"dof": 4}, 50)) == 0
        assert len(draw_band(ax, NEES, 0)) == 0
        assert len(ax.patches) == 1
    curves = make_curves(kf=4.0, imm=6.0)
    with_band = over_time_figure(curves, METRICS, "m")
    assert_png(with_band)
    assert over_time_figure(curves, [m for m in METRICS if m is not NEES], "m") != with_band
    assert over_time_figure(curves, [{k: v for k, v in m.items() if k != "dof"} for m in METRICS], "m") != with_band


def test_curves_far_apart_share_a_logarithmic_axis():
    near, far = np.full(10, 4.0), np.full(10, 4e4)
    assert needs_log([near, far])
    assert not needs_log([near, near + 4.0])
    assert not needs_log([near, np.append(far, 0.0)])
    assert not needs_log([np.full(3, np.nan)])
    curves = make_curves(kf=4e4, imm=4.0)
    with fixed_look():
        ax = new_figure(4.0, 3.0).subplots()
        draw_curves(ax, NEES, {label: c["nees"] for label, c in curves.items()}, styles_of(LABELS), "m")
    low, high = ax.get_ylim()
    assert ax.get_yscale() == "log"
    assert low < band(4, 50)[0]
    assert high > 4e4
    assert_png(over_time_figure(curves, METRICS, "m"))


def test_intervals_on_a_logarithmic_axis_stay_positive():
    curve = Curve(np.array([4.0]), np.array([100.0]), 100)
    inner, outer = bands(curve, is_root=True, is_log=True)
    np.testing.assert_allclose(inner[:, 0], 2.0 * np.exp([0.0, -2.45, 2.45]))
    assert outer is None


def test_a_squared_curve_is_not_shown_twice():
    both = [METRICS[0] | {"name": name} for name in ("run_mse", "effective_samples", "run_rmse")]
    assert [m["name"] for m in chosen_metrics(both, 6)] == ["run_rmse", "effective_samples"]
    assert [m["name"] for m in chosen_metrics(both[:1], 6)] == ["run_mse"]


def make_scores(modes, status):
    runs, n_steps, _ = modes.shape
    steps = np.zeros((runs, n_steps))
    path = Track(np.zeros((runs, n_steps, 4)), {}, steps, steps.astype(int), None, modes)
    return Scores(np.zeros((runs, 1)), steps[..., None], status, np.full(runs, -1), path)  # type: ignore[arg-type]


def test_mode_probabilities_over_chunks_are_the_mean_over_sound_runs(tmp_path):
    modes = np.random.default_rng(4).dirichlet(np.ones(3), (30, 7))
    status = np.where(np.arange(30) % 11 == 5, int(Status.DIVERGED), 0)
    with RunFolder.open(tmp_path, make_manifest()) as folder:
        for start, stop in ((0, 18), (18, 30)):
            padded = np.minimum(np.arange(start, start + 18), stop - 1)
            arrays = score_arrays("imm", make_scores(modes[padded], status[padded]), stop - start)
            arrays |= score_arrays("kf", make_scores(modes[padded], status[padded]), stop - start)
            folder.write_chunk(start, stop, without_tracks({k: v for k, v in arrays.items() if k != "kf/mode_sum"}))
    reader = read_folder(tmp_path)
    found = mode_shares(reader, "imm")
    assert found is not None
    np.testing.assert_allclose(found, modes[status == 0].mean(axis=0), rtol=1e-12)
    assert mode_shares(reader, "kf") is None


def test_names_of_modes_keep_the_order_of_their_probabilities():
    def estimate(mean):
        return Estimate(mean, jnp.eye(2), Point(("x", "y"), 2), {"m2": mean[0], "m10": mean[1], "m1": 0.0 * mean[0]})

    def untouched(*given):
        return given[0]

    flt = Filter(lambda prior, key: prior.mean, untouched, untouched, estimate)
    prior = StatePrior(jnp.asarray([0.75, 0.25]), jnp.eye(2))
    assert mode_names(flt, prior) == ["m2", "m10", "m1"]
    told = report(estimate(prior.mean), Info(jnp.zeros(()), jnp.zeros(()), jnp.zeros((), int)), jnp.asarray(0), False)
    np.testing.assert_array_equal(told.modes, [0.75, 0.25, 0.0])
    without = flt._replace(estimate=lambda mean: estimate(mean)._replace(modes=None))
    assert mode_names(without, prior) == []


def test_places_of_ranges_and_bearings():
    truth = np.array([[[3.0, 4.0], [-6.0, 8.0]]])
    sensor = RangeBearing(jnp.asarray([1.0, -2.0]), 0.1, 0.1)
    values = jnp.stack([jnp.stack([sensor.observe(jnp.asarray(x), jnp.asarray(0.0)) for x in run]) for run in truth])
    mask = jnp.asarray([[[True], [False]]])
    places = scan_places(sensor, Measurements(values[:, :, None], mask, jnp.zeros((1, 2), bool)))
    np.testing.assert_allclose(places, [[[3.0, 4.0], [np.nan, np.nan]]], rtol=1e-12)

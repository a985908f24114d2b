"""A run is the same alone, in any chunk, in any company."""

import threading
import time
from copy import copy
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import jax.numpy as jnp
import numpy as np
import pytest

from emt.config.load import load_experiment
from emt.montecarlo.chunks import Engine, chunk_runs
from emt.montecarlo.program import Program
from emt.status import FAILURE, Status
from tests.montecarlo.small import TEXT, write


@cache
def engine(*overrides: str, text: str = TEXT) -> Engine:
    """A compiled engine of the small experiment with some settings changed."""
    with TemporaryDirectory() as folder:
        loaded = load_experiment(str(write(Path(folder), text)), overrides)
    built = Engine(Program.of(loaded.experiment), loaded.experiment.monte_carlo.seed, loaded.experiment.chunk_size)
    built.compile()
    return built


def values(arrays, label="feldmann"):
    return arrays[f"{label}/values"]


@pytest.mark.bits
def test_a_run_is_the_same_in_any_chunk_to_the_bit():
    whole = values(engine().run_chunk(0, 16))
    for start, stop in [(5, 6), (3, 9), (8, 24)]:
        part = values(engine().run_chunk(start, stop))
        n = min(stop, 16) - start
        np.testing.assert_array_equal(part[:n], whole[start : start + n])


def test_other_chunk_sizes_change_rounding_only():
    larger = engine("monte_carlo.chunk=48")
    np.testing.assert_allclose(
        values(larger.run_chunk(0, 48))[:16], values(engine().run_chunk(0, 16)), rtol=1e-12, atol=0
    )


@pytest.mark.bits
def test_one_more_run_changes_no_other_run():
    np.testing.assert_array_equal(values(engine().run_chunk(0, 9))[:8], values(engine().run_chunk(0, 8)))


VB = "  vb: {kind: vb_random_matrix, iterations: 2}\n"


@pytest.mark.bits
def test_one_more_filter_changes_no_other_filter():
    with_vb = engine(text=TEXT.replace("metrics:", VB + "metrics:"))
    both = with_vb.run_chunk(0, 16)
    np.testing.assert_array_equal(values(both), values(engine().run_chunk(0, 16)))
    assert not np.array_equal(values(both, "vb"), values(both))


@pytest.mark.bits
def test_without_their_points_scans_give_the_same_results():
    """Filters of statistics are not given points, unless every report is asked for."""
    lean, full = engine(), engine("traces=true")
    assert (lean.program.needs_points, full.program.needs_points) == (False, True)
    ours, theirs = lean.run_chunk(0, 16, tracked=1), full.run_chunk(0, 16)
    np.testing.assert_array_equal(values(ours), values(theirs))
    np.testing.assert_array_equal(ours["scans/points"], theirs["scans/points"][:1])


@pytest.mark.bits
def test_one_more_padding_slot_changes_no_detection_and_no_result():
    padded = engine("scenario.detections.max_points=25")
    ours, theirs = engine().run_chunk(0, 16, tracked=16), padded.run_chunk(0, 16, tracked=16)
    mask = ours["scans/mask"]
    np.testing.assert_array_equal(theirs["scans/mask"][..., :24], mask)
    assert not theirs["scans/mask"][..., 24].any()
    np.testing.assert_array_equal(theirs["scans/points"][..., :24, :][mask], ours["scans/points"][mask])
    np.testing.assert_allclose(values(theirs), values(ours), rtol=1e-12, atol=0)


def with_seed(seed: int) -> Engine:
    """The small experiment with another seed, which is no reason to compile anew."""
    other = copy(engine())
    other.seed = jnp.asarray(seed)
    return other


def test_seeds_and_runs_differ():
    here, there = values(engine().run_chunk(0, 16)), values(with_seed(4).run_chunk(0, 16))
    assert len(np.unique(np.concatenate([here[:, 0], there[:, 0]]))) == 32


def test_sums_per_step_are_those_of_the_tracks():
    arrays = engine().run_chunk(0, 13, tracked=13)
    rows = arrays["feldmann/track/per_step"]
    np.testing.assert_allclose(arrays["feldmann/step_sum"].sum(axis=0), rows.sum(axis=0), rtol=1e-12)
    np.testing.assert_allclose(arrays["feldmann/step_squares"], (rows**2).sum(axis=0), rtol=1e-12)
    assert arrays["feldmann/step_count"].sum() == 13
    np.testing.assert_allclose(values(arrays)[:, 0], rows[:, :, 0].mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(values(arrays)[:, 2], np.sqrt(rows[:, :, 2].mean(axis=1)), rtol=1e-12)


def test_divergence_takes_a_run_out_and_says_when():
    arrays = engine("divergence={position_error_above: 1.5}").run_chunk(0, 16, tracked=16)
    lost = (arrays["feldmann/status"] & Status.DIVERGED) != 0
    assert 0 < lost.sum() < 16
    track, truth = arrays["feldmann/track/mean"][..., :2], arrays["truth/position"]
    beyond = np.linalg.norm(track - truth, axis=-1) > 1.5
    np.testing.assert_array_equal(beyond.any(axis=1), lost)
    np.testing.assert_array_equal(arrays["feldmann/failed_step"], np.where(lost, beyond.argmax(axis=1), -1))
    assert arrays["feldmann/step_count"].sum() == 16 - lost.sum()
    assert ((arrays["feldmann/status"] & int(FAILURE)) != 0).sum() == lost.sum()


def test_steps_at_the_start_can_be_left_out_and_the_first_scan_preceded_by_a_prediction():
    other = engine("skip_steps=2", "start_with=predict").run_chunk(0, 16, tracked=16)
    rows = other["feldmann/track/per_step"]
    np.testing.assert_allclose(values(other)[:, 0], rows[:, 2:, 0].mean(axis=1), rtol=1e-12)
    ours = engine().run_chunk(0, 16, tracked=16)["feldmann/track/per_step"]
    assert not np.isclose(rows, ours, rtol=1e-6).all(axis=(1, 2)).any()


def test_single_precision_agrees_with_double():
    single = engine("monte_carlo.dtype=float32").run_chunk(0, 16)
    # other draws, the same distribution: compare means within their spread
    ours, theirs = values(engine().run_chunk(0, 16))[:, 0], values(single)[:, 0]
    spread = np.hypot(ours.std() / 4, theirs.std() / 4)
    assert abs(ours.mean() - theirs.mean()) < 4 * spread


def test_a_reference_filter_takes_the_place_of_the_truth():
    text = TEXT.replace("metrics:", VB + "reference: vb\nmetrics:")
    arrays = engine(text=text).run_chunk(0, 8, tracked=8)
    assert arrays["vb/values"].shape == (8, 0)
    gap = arrays["feldmann/track/mean"][..., :2] - arrays["vb/track/center"]
    np.testing.assert_allclose(arrays["feldmann/track/per_step"][..., 2], (gap**2).sum(axis=-1), rtol=1e-9)


@pytest.mark.parametrize(("start", "stop"), [(0, 16), (32, 40), (7, 8)])
def test_chunks_are_padded_with_their_last_run(start, stop):
    runs = chunk_runs(start, stop, 16)
    assert len(runs) == 16
    assert list(runs[: stop - start]) == list(range(start, stop))
    assert set(runs[stop - start :]) <= {stop - 1}


@pytest.mark.parametrize(("told", "most"), [("1", 1), ("2", 2), ("8", 2)])
def test_chunks_are_in_work_together_only_if_there_are_threads_for_them(monkeypatch, told, most):
    """What a filter costs is a wall-clock time: on one thread it would hold the work of the other chunk."""
    monkeypatch.setenv("NPROC", told)
    engine, lock, now, seen = Engine.__new__(Engine), threading.Lock(), [0], []
    engine.at_once = 1

    def run_group(ranges, *, tracked):
        with lock:
            now[0] += 1
            seen.append(now[0])
        time.sleep(0.05)
        with lock:
            now[0] -= 1
        return [{"tracked": np.array(tracked)}]

    monkeypatch.setattr(engine, "run_group", run_group)
    ranges = [(10 * k, 10 * k + 10) for k in range(6)]
    found = list(engine.run_chunks(ranges))
    assert [(start, stop) for start, stop, _ in found] == ranges
    assert [int(arrays["tracked"]) for *_, arrays in found] == [1, 0, 0, 0, 0, 0]
    assert max(seen) == most

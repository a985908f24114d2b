"""What a summary needs of all runs: the numbers of plain NumPy, in memory that does not grow with the runs."""

import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import emt.reports.gathering as gathering
from emt.reports.gathering import Total, filter_results, most_blocks, run_flags, step_totals, variance_of
from emt.reports.summary import summarise
from emt.status import Status
from emt.store import RunFolder, read_folder

STEPS, BLOCKS = 20, 8
RULES = ("mean", "std", "rms", "pooled", "max", "peak")


def manifest(steps: int = STEPS, rules=RULES) -> dict:
    metrics = [{"name": rule, "over_runs": rule, "without": [], "unit": "m"} for rule in rules]
    config = {"reference": "truth", "skip_steps": 2, "segments": {"late": [11, 20]}}
    return {
        "identity": {"experiment": "made up", "config": config, "seed": 1},
        "metrics": metrics,
        "filters": ["a"],
        "steps": steps,
    }


def made_up(runs: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Values (run, metric), status, nis and squared errors per step (run, step, metric); a few runs fail."""
    rng = np.random.default_rng(seed)
    rows = rng.gamma(2.0, 1.0, (runs, STEPS, len(RULES)))
    status = np.where(rng.random(runs) < 0.05, int(Status.DIVERGED | Status.FLOOR_USED), 0).astype(np.int32)
    status[rng.random(runs) < 0.1] |= int(Status.GROSS_INNOVATION)
    return {"values": np.sqrt(rows.mean(axis=1)), "status": status, "nis": rng.gamma(1.0, 1.0, runs), "rows": rows}


def chunk_of(truth: dict[str, np.ndarray], start: int, stop: int) -> dict[str, np.ndarray]:
    """What is stored of these runs."""
    status = truth["status"][start:stop]
    sound = (status & int(Status.DIVERGED)) == 0
    kept = np.where(sound[:, None, None], truth["rows"][start:stop], 0.0)
    parts = np.array_split(np.arange(stop - start), BLOCKS)
    return {
        "a/values": truth["values"][start:stop],
        "a/status": status,
        "a/nis": truth["nis"][start:stop],
        "a/step_sum": np.stack([kept[part].sum(axis=0) for part in parts]),
        "a/step_count": np.array([sound[part].sum() for part in parts]),
        "a/step_squares": (kept**2).sum(axis=0),
    }


def write(path: Path, truth: dict[str, np.ndarray], size: int):
    """A folder with these runs in chunks of a size."""
    runs = len(truth["status"])
    with RunFolder.open(path, manifest()) as folder:
        for start in range(0, runs, size):
            folder.write_chunk(start, min(start + size, runs), chunk_of(truth, start, min(start + size, runs)))
    return read_folder(path)


def test_numbers_are_those_of_all_runs_at_once(tmp_path):
    truth = made_up(1000)
    reader = write(tmp_path, truth, 30)
    sound = (truth["status"] & int(Status.DIVERGED)) == 0
    values, rows = truth["values"][sound], truth["rows"][sound]
    results = filter_results(reader, "a", [3, 0])
    np.testing.assert_array_equal(results.values, values[:, [3, 0]].T)
    np.testing.assert_allclose(results.step_sum.sum(axis=0), rows.sum(axis=0)[:, [3, 0]], rtol=1e-13)
    assert results.step_count.sum() == sound.sum()
    sums, squares, runs = step_totals(reader, "a")
    assert runs == sound.sum()
    np.testing.assert_allclose(sums, rows.sum(axis=0), rtol=1e-14)
    np.testing.assert_allclose(squares, (rows**2).sum(axis=0), rtol=1e-14)
    assert run_flags(reader, "a") == {
        "failed": int((~sound).sum()),
        "failed_runs": np.flatnonzero(~sound)[:20].tolist(),
        "runs_with": {
            "diverged": int((~sound).sum()),
            "floor used": int((~sound).sum()),
            "gross innovation": int(((truth["status"] & int(Status.GROSS_INNOVATION)) != 0).sum()),
        },
        "mean_nis": pytest.approx(truth["nis"][sound].mean(), rel=1e-15),
    }


def test_the_number_of_metrics_at_a_time_changes_nothing(tmp_path, monkeypatch):
    reader = write(tmp_path, made_up(1000), 60)
    at_once = summarise(reader)
    assert set(at_once["segments"]["a"]) == {"rms", "pooled"}
    monkeypatch.setattr(gathering, "GATHERED_BYTES", 1)
    assert list(gathering.column_groups(reader, [0, 2, 5])) == [[0], [2], [5]]
    assert summarise(reader) == at_once


def test_values_do_not_depend_on_the_chunks(tmp_path, monkeypatch):
    """Slices are of fixed size, whatever the chunks."""
    monkeypatch.setattr(gathering, "SLICE", 64)
    truth = made_up(500)
    one, other = (summarise(write(tmp_path / str(size), truth, size)) for size in (500, 7))
    for name in ("mean", "std", "pooled", "max"):
        assert one["filters"]["a"][name] == other["filters"]["a"][name]
    assert one["filters"]["a"]["rms"]["value"] == pytest.approx(other["filters"]["a"]["rms"]["value"], rel=1e-14)
    assert one["status"] == other["status"]


def test_a_variance_by_slices_is_that_of_numpy(monkeypatch):
    values = 1e3 + made_up(3000)["values"][:, 0]
    assert variance_of(values) == np.var(values, ddof=1)  # a single slice: to the bit
    monkeypatch.setattr(gathering, "SLICE", 100)
    assert variance_of(values) == pytest.approx(np.var(values, ddof=1), rel=1e-13)
    assert variance_of(values, np.square) == pytest.approx(np.var(values**2, ddof=1), rel=1e-13)


def test_small_summands_are_not_lost():
    total = Total()
    assert total.value() == 0.0
    for values in ([1e16, 1.0], [1.0, 1e16], [1.0, 1.0], [-1e16, -1e16]):
        total.add(np.array(values))
    np.testing.assert_array_equal(total.value(), [2.0, 2.0])


def test_very_long_runs_have_fewer_blocks():
    assert most_blocks(1000) == 512
    assert most_blocks(10_000) == 52
    assert most_blocks(10**6) == 16


def peak_of_summary(path: Path) -> int:
    """Bytes in use at the peak while a folder is summarised."""
    reader = read_folder(path)
    tracemalloc.start()
    summarise(reader)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


def test_memory_does_not_grow_with_the_runs(tmp_path, monkeypatch):
    """As many metrics at a time as fit; status, sums and flags in constant memory."""
    monkeypatch.setattr(gathering, "GATHERED_BYTES", 2**17)
    monkeypatch.setattr(gathering, "MAX_BLOCKS", 16)
    monkeypatch.setattr(gathering, "SLICE", 1000)
    truth, size = made_up(500), 500
    runs = 20 * size
    for folder, chunks in (("few", 2), ("many", 20)):
        with RunFolder.open(tmp_path / folder, manifest()) as out:
            for k in range(chunks):
                out.write_chunk(k * size, (k + 1) * size, chunk_of(truth, 0, size))
    few, many = peak_of_summary(tmp_path / "few"), peak_of_summary(tmp_path / "many")
    assert many - few < 2 * 8 * runs  # of six metrics: the values of one


PEAK = """
import resource, sys
import emt.reports.figures
from emt.reports.summary import curves, summarise
from emt.store import read_folder
reader = read_folder(sys.argv[1])
summarise(reader), curves(reader, "a")
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in kB there")
def test_a_million_runs_take_little_more_memory_than_a_thousand(tmp_path):
    truth, size, peaks = made_up(1040), 1040, []
    for chunks in (1, 962):
        path = tmp_path / str(chunks)
        with RunFolder.open(path, manifest()) as out:
            arrays = chunk_of(truth, 0, size)
            for k in range(chunks):
                out.write_chunk(k * size, (k + 1) * size, arrays)
        done = subprocess.run([sys.executable, "-c", PEAK, path], capture_output=True, text=True, check=True)
        peaks.append(int(done.stdout))
    assert peaks[1] - peaks[0] < 24 * 1024  # less than a tenth of what `emt run` takes

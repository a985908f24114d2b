"""`emt bench`: counts, clocks, rivals that must agree, what it writes and what it refuses."""

import json
import os
import sys
from functools import cache, partial

import numpy as np
import pytest

from emt.benchmark import compiling, measure, peak, processes, rivals, workloads
from emt.benchmark.clock import Cost, interleaved, one_core
from emt.benchmark.compiling import compile_costs
from emt.benchmark.goals import GOALS, goals_table, verdicts
from emt.benchmark.operations import COUNTS, mem_ekf_star, moment_ukf, multiple_model, shape_mixture, vb
from emt.benchmark.peak import measured_peak
from emt.benchmark.report import markdown, workload_table
from emt.benchmark.reproducing import done, reproduced_table, timed
from emt.benchmark.rivals import BATCHED, NEEDS_CHECKOUT, NEEDS_PEERS, PER_RUN, PLAIN, DisagreementError, Missing
from emt.benchmark.scaling import one_size, scaling_table
from emt.benchmark.standard import WORKLOADS
from emt.benchmark.workloads import Bench, load_workload, prepared
from emt.cli.reproducing import progress
from emt.reports.paper import TIMING_FILE
from tests.cli.run_emt import emt
from tests.montecarlo.small import write

SMALL = ("monte_carlo.chunk=4", "monte_carlo.runs=4", "scenario.steps=5")


@cache
def small() -> Bench:
    """The first workload with few runs and steps."""
    return prepared("vb", SMALL)


@cache
def measured() -> dict:
    """It on the clock."""
    return measure.measure("vb", repetitions=2, peers=True, peak=1e10, overrides=SMALL, compiling=False)


def results_of(found: dict) -> dict:
    """Results with one workload, its compilation made up."""
    costs = {"cold": {"cpu": 10.0, "wall": 11.0, "memory": 500.0}, "warm": {"cpu": 1.0, "wall": 1.5, "memory": 400.0}}
    about = measure.circumstances(2, 1, peak.Peak(1e10, 1, 64, 8))
    return about | {"workloads": {"vb": found | {"compile": costs}}, "help_seconds": 0.2}


def test_operations_are_those_of_the_equations():
    """Beside counts made by somebody else, who wrote the equations out in another way."""
    assert vb(10, 10) == pytest.approx(2300, rel=0.1)
    assert mem_ekf_star(10) == pytest.approx(4300, rel=0.4)
    assert moment_ukf(10) == pytest.approx(21000, rel=0.4)


def test_operations_grow_with_the_sizes():
    assert vb(10, 20) - vb(10, 10) == vb(10, 10) - vb(10, 0)
    assert vb(20, 10) - vb(10, 10) == 100
    assert shape_mixture(1, 64) > 1.8 * shape_mixture(1, 32)
    assert 3.5 * multiple_model(1, 13) > multiple_model(1, 26) > 2 * multiple_model(1, 13)
    for count in (mem_ekf_star, moment_ukf):
        assert count(20) - count(10) == pytest.approx(count(10) - count(0))


def test_settings_of_the_workloads_enter_the_counts():
    assert set(COUNTS) == set(WORKLOADS) - {"particle"}
    bench = small()
    assert bench.operations() == pytest.approx(vb(bench.points_per_scan(), 10))
    for name in ("shape_mixture", "multiple_model"):
        loaded = load_workload(name)
        label = next(iter(loaded.experiment.filters))
        count = bench._replace(name=name, loaded=loaded, label=label).operations()
        assert count == COUNTS[name](bench.points_per_scan(), {"samples": {"count": 32}, "motions": 13})


def test_repetitions_are_interleaved():
    order: list[str] = []
    long = np.ones(20_000_000)
    calls = {"a": lambda: (order.append("a"), np.exp(long)), "b": lambda: order.append("b")}
    costs = interleaved(calls, 3)
    assert [cost.repetitions for cost in costs.values()] == [3, 3]
    assert order.count("a") == 4  # once to warm up
    assert order.count("b") > 100  # too short for the clock
    assert "aa" not in "".join(order)
    assert costs["a"].wall > costs["b"].wall > 0.0


def test_long_calls_are_repeated_less(monkeypatch):
    monkeypatch.setattr("emt.benchmark.clock.LONG_SECONDS", 0.0)
    assert interleaved({"a": lambda: sum(range(1000))}, 9)["a"].repetitions == 3


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system has no affinities")
def test_bound_to_one_core_for_a_while():
    before = os.sched_getaffinity(0)
    with one_core() as core:
        assert os.sched_getaffinity(0) == {core}
    assert os.sched_getaffinity(0) == before


def test_peak_is_that_of_a_processor():
    found = measured_peak(operations=1e6)
    assert 1e8 < found.flops < 1e12


def test_rivals_agree_and_are_compared():
    found = measured()
    json.dumps(found)
    assert {rival["name"] for rival in found["rivals"]} >= {BATCHED, PER_RUN, PLAIN}
    assert (found["runs"], found["steps"], found["number"]) == (4, 5, "W1")
    for rival in found["rivals"]:
        assert rival["difference"] < 1e-9
        assert rival["ratio"] == pytest.approx(rival["cpu"] / found["parts"]["filter"]["cpu"])
    assert found["share_of_peak"] == pytest.approx(found["operations_per_second"] / 1e10)
    text = workload_table(found).render("text")
    assert "emt, filter only" in text
    assert "of the multiply-add peak" in text


def test_a_rival_that_computes_something_else():
    bench = small()
    (rival, *_), _ = rivals.rivals_of(bench, peers=False)
    right = np.asarray(rival.call())
    wrong, turned = right * (1.0 + 1e-6), right - [0, 0, 0, 0, 0, 0, np.pi]
    assert rivals.agreement(rival._replace(call=lambda: turned), bench).difference < 1e-9
    with pytest.raises(DisagreementError, match="vb: batched NumPy does not report"):
        rivals.agreement(rival._replace(call=lambda: wrong), bench)
    with pytest.raises(DisagreementError, match="reports"):
        rivals.agreement(rival._replace(call=lambda: wrong[:, :2]), bench)
    with pytest.raises(DisagreementError, match="nan"):
        rivals.agreement(rival._replace(call=lambda: wrong * np.nan), bench)


def test_filters_with_random_numbers_are_compared_by_their_errors():
    truth = np.zeros((32, 5, 4))
    own, other = np.random.default_rng(1).normal(size=(2, 32, 5, 4))
    arrays = {"f/track/mean": own, "truth/state": truth}
    bench = small()._replace(name="particle", label="f", arrays=arrays)
    rival = rivals.Rival("other", "", 32, False, None, lambda: other)
    found = rivals.agreement(rival, bench)
    assert abs(found.difference) < 4.0 * found.standard_error
    assert "±" in found.text()
    with pytest.raises(DisagreementError, match="position errors differ"):
        rivals.agreement(rival._replace(call=lambda: 2.0 * other), bench)


def test_what_cannot_be_measured_is_listed(monkeypatch, tmp_path):
    monkeypatch.setattr(rivals, "SHIPPED", tmp_path)
    monkeypatch.setattr(rivals, "installed", lambda peer: None)
    assert rivals.numpy_references(small()) == [Missing(name, NEEDS_CHECKOUT) for name in (BATCHED, PER_RUN)]
    (peer,) = rivals.other_packages(small())
    assert peer == Missing("pyrecest VBRMTracker", NEEDS_PEERS)
    text = workload_table(measured() | {"rivals": [], "missing": [peer._asdict()]}).render("text")
    assert "pip install 'emt[peers]'" in text


def test_verdicts():
    results = results_of(measured())
    found = {row["goal"]: row["reached"] for row in verdicts(results)}
    assert found["vb, warm start: of cold compilation"] is True
    assert found["emt --help"] is True
    assert len(found) == sum(goal.topic in ("vb", "start") for goal in GOALS)
    results["scaling"] = [{"runs": 1_000, "memory": 400.0}, {"runs": 1_000_000, "memory": 480.0}]
    assert verdicts(results)[-1]["reached"] is False
    for scale, wall, reached in (("paper", 300.0, False), ("paper", 200.0, True), ("smoke", 200.0, None)):
        results["reproduce"] = {"scale": scale, "wall": wall}
        last = verdicts(results)[-1]
        assert (last["goal"], last["reached"]) == ("emt reproduce at paper scale, on two cores", reached)
    results["workloads"]["vb"] = results["workloads"]["vb"] | {"rivals": []}
    table = goals_table(verdicts(results)).render("text")
    assert "not measured" in table
    assert "1.20 ×" in table


def test_page():
    results = results_of(measured())
    results["goals"] = verdicts(results)
    text = markdown(results)
    for part in ("Machine: ", "XLA flags", "W1 vb", "**Goals**", "interleaved", "10.0 Gflop/s"):
        assert part in text


def test_processes_that_fail():
    with pytest.raises(processes.ChildError, match="it ended with code 1: gone"):
        processes.run_child("it", [sys.executable, "-c", "raise SystemExit('gone')"])


def test_compilation_in_processes_of_their_own(tmp_path):
    costs = compile_costs("vb", tmp_path, SMALL)
    assert costs["warm"]["cpu"] < costs["cold"]["cpu"]
    assert min(cost["memory"] for cost in costs.values()) > 100.0
    assert any(tmp_path.iterdir())


def test_one_size_of_scaling(tmp_path, monkeypatch):
    monkeypatch.setenv("EMT_CACHE", str(tmp_path))
    row = one_size(6, ["monte_carlo.chunk=4", "scenario.steps=5"])
    assert row["runs"] == 6
    assert row["wall"] > row["compile_seconds"] > 0.0
    assert row["runs_per_second"] > 0.0
    assert row["memory"] > 100.0
    assert "1.000" in scaling_table([row]).render("text")


def test_costs_of_reproduction(tmp_path):
    """From what the command says, and from the run folders."""
    told = {"a/one": "8 runs in 6.5 s", "b/two": "3 runs in 0.5 s"}
    lines = [progress(k, 2, 10.0 * k, name, text) for k, (name, text) in enumerate(told.items(), start=1)]
    lines.insert(1, "c/three: skipped, it needs its recording: --data PATH")
    assert done(lines) == [("a/one", 6.5), ("b/two", 0.5)]
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / TIMING_FILE).write_text('{"compile_seconds": 4.0, "run_seconds": 1.5, "runs": 8}')
    rows = [timed("a/one", 6.5, tmp_path / "one"), timed("b/two", 0.5, tmp_path / "two")]
    assert rows[0] == {"name": "a/one", "runs": 8, "compiling": 4.0, "running": 1.5, "rest": 1.0, "wall": 6.5}
    assert rows[1] == {"name": "b/two", "runs": None, "compiling": None, "running": None, "rest": None, "wall": 0.5}
    table = reproduced_table({"scale": "smoke", "wall": 5.0, "experiments": rows, "skipped": ["c/three"]})
    assert table.values[-1] == {"name": "in all", "compiling": 4.0, "running": 1.5, "rest": 1.0, "wall": 5.0}
    assert "c/three" in table.render("text")


def test_command(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(workloads, "load_workload", lambda name, overrides=(): load_workload(name, SMALL))
    monkeypatch.setattr(measure, "compile_costs", lambda *given: results_of({})["workloads"]["vb"]["compile"])
    monkeypatch.setattr(peak, "measured_peak", partial(measured_peak, 1e6))
    monkeypatch.setattr(processes, "help_seconds", lambda: 0.1)
    file, folder = tmp_path / "all.json", tmp_path / "deep" / "report"
    done = emt(capsys, "bench", "vb", "--repetitions", "2", "--json", file, "--report", folder)
    assert done.code == 0, done.err
    assert "vb: batched NumPy agrees" in done.err
    for text in ("W1 vb", "emt, end to end", "Goals", "interleaved"):
        assert text in done.out
    found = json.loads(file.read_text())
    assert found["workloads"]["vb"]["runs"] == 4
    assert found["environment"]["jax"]
    assert {row["goal"] for row in found["goals"]} >= {"emt --help"}
    assert (folder / "benchmark.md").read_text().startswith("# Benchmark")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.json", "deep"]

    monkeypatch.setattr(rivals, "LARGEST_DIFFERENCE", -1.0)
    done = emt(capsys, "bench", "vb", "--repetitions", "2")
    assert done.code == 1
    assert "the largest relative difference is" in done.err


def test_any_experiment_part_by_part(tmp_path, capsys):
    file = tmp_path / "parts.json"
    config = write(tmp_path)
    done = emt(capsys, "bench", config, "--repetitions", "1", "--json", file)
    assert done.code == 0, done.err
    for text in ("simulation", "feldmann, filter only", "feldmann, with metrics", "one run alone", "peak memory"):
        assert text in done.out
    (rows,) = json.loads(file.read_text())["parts"].values()
    assert {row["part"] for row in rows} >= {"simulation", "feldmann, filter only"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["vbb"], "unknown workload 'vbb' (did you mean 'vb'?)"),
        (["vb", "reprodce"], "did you mean 'reproduce'?"),
        (["tuncer2021/trajectory_unifrm"], "did you mean 'tuncer2021/trajectory_uniform'?"),
        (["nowhere.yaml"], "nowhere.yaml"),
        (["vb", "--json", "nowhere/all.json"], "--json nowhere/all.json: there is no folder nowhere"),
        (["vb", "--json", "."], "--json .: cannot be written"),
        (["scaling", "--runs", "10,x"], "--runs 10,x: expected numbers of runs"),
        (["vb", "--repetitions", "0"], "--repetitions"),
        (["vb", "yao2020/car"], "give them to two commands"),
    ],
)
def test_refusals_come_before_any_measurement(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(measure, "measure", pytest.fail)
    monkeypatch.setattr(compiling, "compile_costs", pytest.fail)
    done = emt(capsys, "bench", *arguments)
    assert done.code == 2
    assert message in " ".join(done.err.split())
    assert not done.out
    assert not list(tmp_path.iterdir())


def test_costs_are_per_run_and_step():
    assert measure.per_run_and_step(Cost(2.0, 4.0, 3), 1000) == {"cpu": 2000.0, "wall": 4000.0, "repetitions": 3}

"""What travels to workers builds the same experiment there, or is refused with a reason."""

import importlib
import json
import sys

import numpy as np
import pytest

from emt.cluster import parcel as parcels
from emt.cluster import tasks
from emt.cluster.parcel import Parcel, ParcelError, pack, unpack
from emt.config.load import load_experiment
from emt.montecarlo.identity import identity_of
from emt.montecarlo.program import Program
from emt.registry import FILTERS
from tests.montecarlo.small import TEXT, write

PLUGIN = """
from emt.registry import FILTERS
from emt.settings import Settings


class MineSettings(Settings):
    kind: str = "mine"

    def build(self):
        entry = FILTERS.get("feldmann")
        return entry.builder(entry.settings(weight=WEIGHT, decay={"kind": "weight", "factor": 0.9}))
"""
RECORDED = """
scenario: {kind: recorded, path: scans.csv, dt: 1 s}
model:
  process_noise: {kind: white_acceleration, psd: 0.01}
  noise_cov: [[0.5, 0.1], [0.1, 0.4]]
  extent_scale: 0.25
  prior: {mean: [1, -1, 0, 0], cov: {diagonal: [4, 4, 1, 1]}, semi_axes: [8, 5]}
filters:
  feldmann: {kind: feldmann, weight: 8, decay: {kind: weight, factor: 0.9}}
metrics: []
"""


def packed(path, *overrides) -> Parcel:
    """The parcel of a file, after the journey."""
    loaded = load_experiment(str(path), overrides)
    name, file, data, plugins, *rest = json.loads(json.dumps(pack(loaded, Program.of(loaded.experiment))))
    return Parcel(name, file, data, {module: tuple(found) for module, found in plugins.items()}, *rest)


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """Writes and imports a plug-in whose weight is given; returns the experiment that uses it."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(FILTERS, "_loaded", {})

    def written(weight: float):
        (tmp_path / "mine_beside.py").write_text(f"WEIGHT = {weight}\n{PLUGIN}", encoding="utf-8")
        sys.modules.pop("mine_beside", None)
        importlib.invalidate_caches()
        FILTERS.forget()
        text = TEXT.replace("\nmetrics:", "\n  mine: {kind: 'mine_beside:MineSettings'}\nmetrics:")
        return write(tmp_path, text)

    yield written
    sys.modules.pop("mine_beside", None)


def test_the_experiment_is_the_same_over_there(tmp_path, monkeypatch):
    """Overrides, name and chunk size included; the directory of the worker does not matter."""
    path = write(tmp_path, name="other.yaml")
    loaded = load_experiment(str(path), ["filters.feldmann.weight=9", "monte_carlo.seed=4"])
    parcel = packed(path, "filters.feldmann.weight=9", "monte_carlo.seed=4")
    path.unlink()  # workers do not read it
    monkeypatch.chdir("/")
    engine = unpack(parcel)
    assert engine.program.experiment == loaded.experiment
    assert (int(engine.seed), engine.chunk_size, engine.labels()) == (4, 16, ["feldmann"])
    assert parcel.key() != packed(write(tmp_path)).key()


def test_a_recording_is_known_by_its_content(tmp_path, monkeypatch):
    (tmp_path / "scans.csv").write_text("frame,x,y\n1,0,0\n1,1,2\n2,1,1\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, RECORDED)
    parcel = packed(path.relative_to(tmp_path))
    monkeypatch.chdir("/")
    world = unpack(parcel).program.world.scenario
    np.testing.assert_array_equal(world.mask.sum(axis=1), [2, 1])
    (tmp_path / "scans.csv").write_text("frame,x,y\n1,0,0\n1,1,2\n2,1,1.5\n", encoding="utf-8")
    with pytest.raises(ParcelError, match="its recording or its plug-ins differ"):
        unpack(parcel)
    (tmp_path / "scans.csv").unlink()
    with pytest.raises(ParcelError, match=r"the worker on \S+ cannot use the recording.*must be readable by workers"):
        tasks.compute(parcel, 0, 1, 0)


def test_plugins_beside_the_file_travel_by_name_and_checksum(plugin):
    parcel = packed(plugin(8.0))
    assert list(parcel.plugins) == ["mine_beside"]
    assert parcel.plugins["mine_beside"][0] == "mine_beside.py"
    assert unpack(parcel).labels() == ["feldmann", "mine"]


def test_a_worker_older_than_an_edit_imports_the_plugin_again(plugin):
    packed(plugin(8.0))
    old = sys.modules["mine_beside"]
    path = plugin(24.5)
    loaded = load_experiment(str(path))
    program = Program.of(loaded.experiment)
    parcel = pack(loaded, program)
    sys.modules["mine_beside"] = old  # as in a worker that has computed with it before
    FILTERS.forget()
    FILTERS.get("mine_beside:MineSettings")
    engine = unpack(parcel)
    assert sys.modules["mine_beside"] is not old
    assert float(engine.program.filter_params["mine"].weight) == 24.5
    assert identity_of(loaded, program) == identity_of(loaded, engine.program)


def test_another_plugin_than_that_of_the_client_is_refused(plugin, tmp_path):
    parcel = packed(plugin(8.0))
    (tmp_path / "mine_beside.py").write_text(f"WEIGHT = 9.0\n{PLUGIN}", encoding="utf-8")
    with pytest.raises(ParcelError, match="changed since the run began"):
        unpack(parcel)
    (tmp_path / "mine_beside.py").unlink()
    with pytest.raises(ParcelError, match="must be readable by workers"):
        unpack(parcel)


def test_other_versions_are_refused(tmp_path, monkeypatch):
    parcel = packed(write(tmp_path))
    monkeypatch.setattr(parcels, "versions", lambda: parcel.versions | {"jax": "0.0.1"})
    with pytest.raises(ParcelError, match=rf"jax 0\.0\.1 instead of {parcel.versions['jax']}.*same versions"):
        unpack(parcel)


def test_a_worker_keeps_few_engines_and_compiles_each_once(tmp_path, monkeypatch):
    built = []

    class FakeEngine:
        def __init__(self, parcel):
            self.parcel, self.seconds = parcel, {"feldmann": []}

        def compile(self):
            built.append(self.parcel.name)

        def run_chunk(self, start, stop, *, tracked):
            self.seconds["feldmann"].append(0.5)
            return {"feldmann/values": np.arange(start, stop)}

    monkeypatch.setattr(tasks, "unpack", FakeEngine)
    monkeypatch.setattr(tasks, "_engines", type(tasks._engines)())
    parcel = packed(write(tmp_path))
    for name in ("a", "b", "a", "c", "a", "b"):
        result = tasks.compute(parcel._replace(name=name), 3, 5, 0)
        assert result.seconds == {"feldmann": 0.5}
        np.testing.assert_array_equal(result.arrays["feldmann/values"], [3, 4])
    assert built == ["a", "b", "c", "b"]
    assert all(engine.seconds == {"feldmann": []} for engine in tasks._engines.values())

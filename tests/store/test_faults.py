"""Every operation fails once, from then on, or with the power; nothing acknowledged may be lost."""

import random
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from itertools import count
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from emt.store import FileSystem, RunFolder, RunReader, StoreError
from tests.store.unreliable import (
    ROOT,
    Failure,
    Loss,
    MemoryDisk,
    PowerCut,
    Unreliable,
    assert_same_arrays,
    make_manifest,
    read_all,
    score_runs,
)

FIRST, SECOND = {"error": 1.0}, {"error": 2.0, "note": "after more runs"}
LOSSES: tuple[Loss, ...] = ("names", "contents", "some")


class QuickDisk(FileSystem):
    """The real disk without waiting for it."""

    def fsync(self, handle: int) -> None:
        pass

    def fsync_dir(self, path: Path) -> None:
        pass


def campaign(fs: FileSystem, path: Path, done: dict[str, object], attempts: int = 1) -> None:
    """Six runs on one device, then four more on another; fills `done` with what was acknowledged."""
    for device, n_runs, summary in (("cpu", 6, FIRST), ("gpu", 10, SECOND)):
        with repeat(lambda d=device: RunFolder.open(path, make_manifest(d), fs), attempts) as folder:
            for start, stop in repeat(lambda f=folder, n=n_runs: f.missing(n, 4), attempts):
                arrays = score_runs(start, stop)
                chunk = repeat(lambda f=folder, a=start, b=stop, x=arrays: f.write_chunk(a, b, x), attempts)
                done[chunk.path.name] = True
            repeat(lambda f=folder, s=summary: f.write_json("summary.json", s), attempts)
            done["summary.json"] = summary


def repeat(action: Callable, attempts: int):
    for left in reversed(range(attempts)):
        try:
            return action()
        except StoreError:
            if not left:
                raise
    raise AssertionError


def check(fs: FileSystem, path: Path, done: dict[str, object]) -> None:
    """All that has a final name is whole, and all that was acknowledged is there."""
    names = {name for name in read_all(fs, path) if not name.endswith(".partial")}
    assert done.keys() <= names
    if not names:
        return
    reader = RunReader(path, fs)
    chunks = reader.chunks()
    assert {chunk.path.name for chunk in chunks} == names - {"manifest.json", "summary.json"}
    for chunk in chunks:
        assert_same_arrays(reader.read_chunk(chunk), score_runs(chunk.start, chunk.stop))
    if "summary.json" in names:
        found = reader.read_json("summary.json")
        assert found == SECOND or (found == FIRST and done.get("summary.json") != SECOND)


@cache
def undisturbed() -> dict[str, bytes]:
    disk = MemoryDisk()
    campaign(disk, ROOT / "new" / "run", {})
    files = read_all(disk, ROOT / "new" / "run")
    assert len(files) == 6  # manifest, summary, chunks 0-4, 4-6, 6-8, 8-10
    return files


@pytest.mark.parametrize(("where", "failure"), [("memory", "once"), ("memory", "always"), ("real", "once")])
def test_any_operation_fails(tmp_path, where, failure: Failure):
    expected = undisturbed()
    for n in count(1):
        disk, root = (MemoryDisk(), ROOT) if where == "memory" else (QuickDisk(), tmp_path / str(n))
        root.mkdir() if where == "real" else None
        path, done = root / "new" / "run", {}
        fs = Unreliable(disk, n, failure)
        try:
            campaign(fs, path, done)
        except StoreError as error:
            message = str(error)
        else:
            message = ""
        assert not message or "then run the same command again" in message  # in words, no raw OSError
        check(disk, path, done)
        if failure == "once":
            assert not any(name.endswith(".partial") for name in read_all(disk, path))
        campaign(disk, path, {})
        assert read_all(disk, path) == expected
        if not fs.met:
            break
    assert n > 60


def test_any_operation_fails_and_the_call_is_repeated():
    expected = undisturbed()
    for n in count(1):
        disk, path, done = MemoryDisk(), ROOT / "new" / "run", {}
        fs = Unreliable(disk, n)
        campaign(fs, path, done, attempts=2)
        disk.power_cut("names", random.Random(n))  # a repeated call must be as safe as a first one
        check(disk, path, done)
        assert read_all(disk, path) == expected
        if not fs.met:
            break


def test_repeated_call_is_safe_at_once():
    for n in count(1):
        disk, path = MemoryDisk(), ROOT / "run"
        folder = RunFolder.open(path, make_manifest(), disk)
        folder._fs = fs = Unreliable(disk, n)
        chunk = repeat(lambda f=folder: f.write_chunk(0, 4, score_runs(0, 4)), 2)
        disk.power_cut("names", random.Random(n))
        check(disk, path, {chunk.path.name: True})
        if not fs.met:
            break


@pytest.mark.parametrize("loss", LOSSES)
def test_power_cut_at_any_operation(loss: Loss):
    expected, rng = undisturbed(), random.Random(0)
    for n in count(1):
        disk, path, done = MemoryDisk(), ROOT / "new" / "run", {}
        fs = Unreliable(disk, n, "power cut")
        with suppress(PowerCut):
            campaign(fs, path, done)
        disk.power_cut(loss, rng)
        check(disk, path, done)
        campaign(disk, path, {})
        assert read_all(disk, path) == expected
        if not fs.met:
            break
    assert n > 60


@pytest.mark.parametrize("loss", LOSSES)
def test_process_killed_then_power_cut_after_resuming(loss: Loss):
    """What a resumed process builds on must be safe, even if its writer died before saying so."""
    rng = random.Random(0)
    for n in count(1):
        disk, path = MemoryDisk(), ROOT / "new" / "run"
        fs = Unreliable(disk, n, "power cut")
        try:
            campaign(fs, path, {})
        except PowerCut:
            disk.locked.clear()  # killed: the disk keeps everything
        folder = RunFolder.open(path, make_manifest(), disk)
        found = {chunk.path.name: True for chunk in folder.chunks()}
        disk.power_cut(loss, rng)
        check(disk, path, found)
        if not fs.met:
            break


class Life(RuleBasedStateMachine):
    """Opening, writing, extending, faults, kills and power cuts in any order."""

    path = ROOT / "new" / "run"

    @initialize(seed=st.integers(0, 99))
    def start(self, seed: int):
        self.disk = MemoryDisk()
        self.rng = random.Random(seed)
        self.folder: RunFolder | None = None
        self.done: dict[str, object] = {}
        self.n_runs = 6

    def attempt(self, fail_at: int, failure: Failure, action: Callable[[FileSystem], None]) -> None:
        fs = Unreliable(self.disk, fail_at, failure)
        try:
            action(fs)
        except StoreError:
            assert fs.met
        except PowerCut:
            self.lose_power("some")

    @precondition(lambda self: self.folder is None)
    @rule(fail_at=st.integers(0, 30), failure=st.sampled_from(["once", "always", "power cut"]))
    def reopen(self, fail_at: int, failure: Failure):
        def action(fs: FileSystem) -> None:
            self.folder = RunFolder.open(self.path, make_manifest(), fs)
            self.folder._fs = self.disk
            assert not any(name.endswith(".partial") for name in read_all(self.disk, self.path))

        self.attempt(fail_at, failure, action)

    @precondition(lambda self: self.folder is not None)
    @rule(
        size=st.integers(1, 5),
        pick=st.integers(0, 9),
        fail_at=st.integers(0, 9),
        failure=st.sampled_from(["once", "always", "power cut"]),
    )
    def write_one(self, size: int, pick: int, fail_at: int, failure: Failure):
        def action(fs: FileSystem) -> None:
            missing = folder.missing(self.n_runs, size)
            if missing:
                folder._fs = fs
                start, stop = missing[pick % len(missing)]
                chunk = folder.write_chunk(start, stop, score_runs(start, stop))
                self.done[chunk.path.name] = True

        folder = self.folder
        assert folder is not None
        self.attempt(fail_at, failure, action)
        folder._fs = self.disk

    @rule(more=st.integers(1, 5))
    def extend(self, more: int):
        self.n_runs += more

    @rule(loss=st.sampled_from(LOSSES))
    def lose_power(self, loss: Loss):
        self.folder = None
        self.disk.power_cut(loss, self.rng)

    @rule()
    def kill(self):
        self.folder = None
        self.disk.locked.clear()

    @invariant()
    def nothing_is_lost(self):
        check(self.disk, self.path, self.done)

    def teardown(self):
        self.kill()
        with RunFolder.open(self.path, make_manifest(), self.disk) as folder:
            for start, stop in folder.missing(self.n_runs, 4):
                folder.write_chunk(start, stop, score_runs(start, stop))
        ranges = [(chunk.start, chunk.stop) for chunk in folder.chunks()]
        assert folder.missing(self.n_runs, 4) == []
        assert [start for start, _ in ranges] == [0, *(stop for _, stop in ranges[:-1])]
        calm = MemoryDisk()
        with RunFolder.open(self.path, make_manifest(), calm) as folder:
            for start, stop in ranges:
                folder.write_chunk(start, stop, score_runs(start, stop))
        assert read_all(self.disk, self.path) == read_all(calm, self.path)


Life.TestCase.settings = settings(max_examples=50, stateful_step_count=20, deadline=None, database=None)
TestLife = Life.TestCase

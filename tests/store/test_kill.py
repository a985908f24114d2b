"""Real processes on a real disk, killed without warning."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from emt.store import FolderBusy, RunFolder, StoreError, read_folder
from tests.store.unreliable import assert_same_arrays, make_manifest, score_runs

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL and fork")

HEAD = """
import os, sys, time
from emt.store import RunFolder
from tests.store.unreliable import make_manifest, score_runs
folder = RunFolder.open(sys.argv[1], make_manifest())
"""
WRITER = """
for start, stop in folder.missing(100_000, 3):
    folder.write_chunk(start, stop, score_runs(start, stop))
    print(start, stop, flush=True)
"""
HOLDER = "print('ready', flush=True); time.sleep(60)"
# the child of a fork outlives its parent, as a worker does
FORKER = """
child = os.fork()
if child == 0:
    try:
        folder.write_text("note.txt", "")
    except Exception as error:
        print(type(error).__name__, os.getpid(), flush=True)
    time.sleep(60)
    os._exit(0)
time.sleep(60)
"""


@contextmanager
def process(body: str, folder: Path):
    root = Path(__file__).parents[2]
    child = subprocess.Popen(
        [sys.executable, "-c", HEAD + body, str(folder)], cwd=root, stdout=subprocess.PIPE, text=True
    )
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


def test_killed_writer_loses_nothing_it_reported(tmp_path):
    path, rng = tmp_path / "run", random.Random(0)
    reported = []
    for _ in range(4):
        with process(WRITER, path) as child:
            assert child.stdout is not None
            reported.append(child.stdout.readline())
            time.sleep(rng.uniform(0.0, 0.1))
            child.send_signal(signal.SIGKILL)
            reported += child.stdout.readlines()
        reader = read_folder(path)
        found = {(chunk.start, chunk.stop) for chunk in reader.chunks()}
        lines = [line.split() for line in reported if line.endswith("\n")]
        assert {(int(start), int(stop)) for start, stop in lines} <= found
        for chunk in reader.chunks():
            assert_same_arrays(reader.read_chunk(chunk), score_runs(chunk.start, chunk.stop))
    n_runs = reader.chunks()[-1].stop + 6
    for folder in (path, tmp_path / "calm"):
        with RunFolder.open(folder, make_manifest()) as run:
            for start, stop in run.missing(n_runs, 3):
                run.write_chunk(start, stop, score_runs(start, stop))
    names = sorted(os.listdir(path))
    assert names == sorted(os.listdir(tmp_path / "calm"))
    for name in names:
        assert (path / name).read_bytes() == (tmp_path / "calm" / name).read_bytes()


def test_second_process_is_refused_until_the_first_is_killed(tmp_path):
    with process(HOLDER, tmp_path) as child:
        assert child.stdout is not None
        child.stdout.readline()
        with pytest.raises(FolderBusy, match=f"process {child.pid} on .* is writing") as caught:
            RunFolder.open(tmp_path, make_manifest())
        assert caught.value.pid == child.pid
        read_folder(tmp_path)  # reading needs no lock
        child.send_signal(signal.SIGKILL)
        child.wait()
        RunFolder.open(tmp_path, make_manifest()).close()


def test_forked_child_neither_writes_nor_keeps_the_lock(tmp_path):
    with process(FORKER, tmp_path) as child:
        assert child.stdout is not None
        refusal, orphan = child.stdout.readline().split()
        try:
            assert refusal == StoreError.__name__
            with pytest.raises(FolderBusy):  # the child's end of the lock did not free the parent's
                RunFolder.open(tmp_path, make_manifest())
            child.send_signal(signal.SIGKILL)
            child.wait()
            RunFolder.open(tmp_path, make_manifest()).close()
        finally:
            os.kill(int(orphan), signal.SIGKILL)

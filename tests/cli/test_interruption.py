"""Killed or interrupted at any moment, a run loses at most the chunk in flight and ends with the same bytes."""

import random
import signal
import time

import pytest

from emt.cli.errors import InterruptedRunError
from emt.cli.interruption import remembered
from emt.cli.running import run_shown
from emt.config.load import load_experiment
from emt.runner import Progress
from tests.cli.run_emt import start_emt
from tests.montecarlo.small import TEXT, write

# many small chunks, so that moments fall within, between and after them
MANY = TEXT.replace("runs: 40", "runs: 800")


def results(folder):
    """Every file whose bytes follow from the configuration alone."""
    files = [p for p in folder.iterdir() if p.suffix in (".npz", ".md", ".png") or p.name == "summary.json"]
    return {p.name: p.read_bytes() for p in files}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """(configuration, compilation cache, results) of a run that nobody disturbed."""
    folder = tmp_path_factory.mktemp("undisturbed")
    config, cache = write(folder, MANY), folder / "cache"
    process = start_emt("run", config, "--out", folder / "out", cwd=folder, cache=cache)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, out + err
    return config, cache, results(folder / "out")


def wait_for_chunks(folder, count, process):
    """Waits until the run has written this many chunks."""
    deadline = time.monotonic() + 120
    while len(list(folder.glob("chunk-*.npz"))) < count:
        assert time.monotonic() < deadline
        if process.poll() is not None:
            return
        time.sleep(0.002)


def test_the_same_command_continues_and_ends_with_the_same_bytes(tmp_path, undisturbed):
    config, cache, expected = undisturbed
    out, moments = tmp_path / "out", random.Random(9)
    for stop in (signal.SIGKILL, signal.SIGINT, signal.SIGKILL):
        present = len(list(out.glob("chunk-*.npz")))
        process = start_emt("run", config, "--out", out, cwd=tmp_path, cache=cache)
        wait_for_chunks(out, present + moments.randint(1, 12), process)
        time.sleep(moments.uniform(0.0, 0.01))
        before = {p.name for p in out.glob("chunk-*.npz")}
        process.send_signal(stop)
        _, err = process.communicate(timeout=60)
        assert before <= {p.name for p in out.glob("chunk-*.npz")}
        if stop == signal.SIGINT and process.returncode != 0:
            assert process.returncode == 1
            assert "interrupted" in err
            assert "the same command continues" in err
    process = start_emt("run", config, "--out", out, cwd=tmp_path, cache=cache)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert results(out) == expected


def test_a_second_process_in_the_same_folder_is_refused(tmp_path, undisturbed):
    config, cache, _ = undisturbed
    out = tmp_path / "out"
    first = start_emt("run", config, "--out", out, cwd=tmp_path, cache=cache)
    wait_for_chunks(out, 1, first)
    second = start_emt("run", config, "--out", out, cwd=tmp_path, cache=cache)
    _, err = second.communicate(timeout=60)
    if first.poll() is None:  # the first was still at work
        assert second.returncode == 2
        assert str(first.pid) in err
    first.communicate(timeout=300)
    assert first.returncode == 0


class EndsWithCtrlC:
    """Is finalised at the moment when the user presses Ctrl-C."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interruption_that_python_drops_is_remembered():
    with remembered() as look:
        look()
        EndsWithCtrlC()  # prints that KeyboardInterrupt is ignored
        with pytest.raises(KeyboardInterrupt):
            look()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_run_whose_interruption_python_drops_ends_at_the_next_chunk(tmp_path, monkeypatch):
    def run(loaded, folder, *, on_progress, **options):
        EndsWithCtrlC()
        on_progress(Progress("running", "chunk 1/2", 16, 32, 1.0, {}))

    monkeypatch.setattr("emt.runner.run", run)
    with pytest.raises(InterruptedRunError, match="16 of 32 runs are kept"):
        run_shown(load_experiment(str(write(tmp_path))), tmp_path)


def test_ctrl_c_that_does_something_else_is_left_alone():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with remembered() as look:
            signal.raise_signal(signal.SIGINT)
            look()
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)

"""Any number of workers, killed or not, leaves the same bytes as this process alone."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import psutil
import pytest

from emt.cluster.connecting import open_pool
from emt.cluster.pool import ClusterError
from emt.config.load import load_experiment
from emt.device import processors
from emt.runner import run
from tests.cli.run_emt import start_emt
from tests.cli.test_interruption import results, wait_for_chunks
from tests.montecarlo.small import TEXT, write

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")

MANY = TEXT.replace("runs: 40", "runs: 400").replace("steps: 4", "steps: 300")  # chunks long enough to be hit


@pytest.fixture(scope="module")
def cache(request, tmp_path_factory):
    """Compiled programs, shared by all processes and kept between test runs where pytest keeps something."""
    kept = getattr(request.config, "cache", None)
    return tmp_path_factory.mktemp("jax") if kept is None else kept.mkdir("jax")


@pytest.fixture(scope="module")
def alone(tmp_path_factory, cache):
    """(configuration, results) without workers."""
    folder = tmp_path_factory.mktemp("alone")
    config = write(folder, MANY)
    process = start_emt("run", config, "--out", folder / "out", cwd=folder, cache=cache)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, out + err
    return config, results(folder / "out")


@pytest.fixture(scope="module")
def two(cache):
    """A pool of two workers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EMT_CACHE", str(cache))
        with open_pool(workers=2) as pool:
            yield pool


def pids_of(pool) -> list[int]:
    """Process ids of the workers."""
    return list(pool._client.run(os.getpid).values())


def test_two_workers_leave_the_same_bytes(alone, two, tmp_path):
    config, expected = alone
    seen = []
    run(load_experiment(str(config)), tmp_path, pool=two, on_progress=seen.append)
    assert results(tmp_path) == expected
    assert [p.done for p in seen if p.stage == "running"] == list(range(16, 401, 16))
    assert seen[0].detail == "2 workers"
    timing = json.loads((tmp_path / "timing.json").read_text())
    assert timing["workers"] == 2
    assert timing["runs"] == 400
    assert timing["microseconds_per_run_and_step"]["feldmann"] > 0
    assert timing["environments"] == [json.loads((tmp_path / "manifest.json").read_text())["environment"]]


def test_workers_share_the_processors(two):
    """Each starts its share of threads, while the process that `alone` is starts all of them: same bytes above."""
    expected = os.environ.get("NPROC", str(max(1, processors() // 2)))
    assert set(two._client.run(os.getenv, "NPROC").values()) == {expected}


def test_a_figure_that_is_missing_is_drawn_by_a_worker(alone, two, tmp_path):
    config, expected = alone
    run(load_experiment(str(config)), tmp_path, pool=two)
    (tmp_path / "track.png").unlink()
    run(load_experiment(str(config)), tmp_path, pool=two)
    assert results(tmp_path) == expected


def test_a_worker_killed_in_the_middle_loses_nothing(alone, two, tmp_path):
    config, expected = alone
    killed = []

    def kill_one(progress):
        if progress.stage == "running" and not killed:
            killed.append(pids_of(two)[0])
            os.kill(killed[0], signal.SIGKILL)

    run(load_experiment(str(config)), tmp_path, pool=two, on_progress=kill_one)
    assert killed
    assert results(tmp_path) == expected


def test_what_a_worker_cannot_do_is_said(two, tmp_path):
    """The file of the filter is gone when the workers look for it."""
    plugin = "from emt.filters.feldmann import FeldmannSettings, build\n\nPLUGIN = FeldmannSettings, build\n"
    (tmp_path / "gone_soon.py").write_text(plugin, encoding="utf-8")
    text = MANY.replace("{kind: feldmann", "{kind: 'gone_soon:PLUGIN'")
    loaded = load_experiment(str(write(tmp_path, text)))

    def remove(progress):
        (tmp_path / "gone_soon.py").unlink(missing_ok=True)

    with pytest.raises(ClusterError, match=r"the worker on \S+ cannot read .*gone_soon.py.*finished chunks are kept"):
        run(loaded, tmp_path / "out", pool=two, on_progress=remove)


@pytest.mark.slow
def test_a_killed_client_leaves_a_folder_that_continues_without_workers(alone, tmp_path, cache):
    config, expected = alone
    out = tmp_path / "out"
    process = start_emt("run", config, "--runs", "40000", "--workers", "2", "--out", out, cwd=tmp_path, cache=cache)
    wait_for_chunks(out, 3, process)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    present = sorted(out.glob("chunk-*.npz"))
    assert len(present) >= 3
    for path in present[25:]:
        path.unlink()  # beyond the runs compared here
    process = start_emt("run", config, "--out", out, cwd=tmp_path, cache=cache)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert results(out) == expected


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 8])
def test_the_number_of_workers_changes_nothing(alone, tmp_path, cache, workers):
    config, expected = alone
    process = start_emt("run", config, "--workers", workers, "--out", tmp_path, cwd=tmp_path, cache=cache)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert results(tmp_path) == expected
    assert "distributed" not in err


@pytest.mark.slow
def test_an_interruption_ends_the_workers_and_says_what_is_kept(alone, tmp_path, cache):
    """As a terminal sends it: to all processes of the group."""
    config, expected = alone
    out = tmp_path / "out"
    code = "import sys; from emt.cli.main import main; sys.argv[0] = 'emt'; main()"
    command = [sys.executable, "-c", code, "run", str(config), "--workers", "2", "--out", str(out)]
    environment = os.environ | {"EMT_CACHE": str(cache)}
    process = subprocess.Popen(
        [*command, "--runs", "40000"], env=environment, text=True, stderr=subprocess.PIPE, start_new_session=True
    )
    wait_for_chunks(out, 3, process)
    workers = psutil.Process(process.pid).children(recursive=True)
    assert len(workers) >= 2
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 1
    assert err.splitlines()[-1].startswith("interrupted: ")
    assert "Traceback" not in err
    _, left = psutil.wait_procs(workers, timeout=10)
    assert not [one for one in left if one.status() != psutil.STATUS_ZOMBIE]
    for path in sorted(out.glob("chunk-*.npz"))[25:]:
        path.unlink()
    done = subprocess.run(command, env=environment, text=True, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert results(out) == expected


@pytest.mark.slow
def test_workers_of_a_running_scheduler(alone, tmp_path, cache):
    """They may come after the run has begun; when the scheduler ends, that is said, and the folder continues."""
    config, expected = alone
    environment, out = os.environ | {"EMT_CACHE": str(cache)}, tmp_path / "out"
    address = f"tcp://127.0.0.1:{free_port()}"

    def dask(*arguments) -> subprocess.Popen:
        command = [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]]
        log = (tmp_path / f"{arguments[0]}.log").open("w")
        return subprocess.Popen(command, env=environment, cwd=tmp_path, stdout=log, stderr=log)

    def emt(*arguments) -> subprocess.Popen:
        return start_emt("run", config, "--scheduler", address, *arguments, cwd=tmp_path, cache=cache)

    scheduler = dask("dask_scheduler", "--host", "127.0.0.1", "--port", address.split(":")[-1], "--no-dashboard")
    worker = None
    try:
        wait_for_server(int(address.split(":")[-1]))
        first = emt("--out", out)
        assert first.stderr is not None
        assert any(f"waiting for workers at {address}" in line for line in first.stderr)  # reads no further
        worker = dask("dask_worker", address, "--nthreads", "1")
        _, err = first.communicate(timeout=300)
        assert first.returncode == 0, err
        assert results(out) == expected
        second = emt("--runs", "400000", "--out", tmp_path / "other")
        wait_for_chunks(tmp_path / "other", 3, second)
        scheduler.terminate()
        _, err = second.communicate(timeout=120)
        assert second.returncode == 2
        assert f"the scheduler at {address} is gone" in err
        assert "finished chunks are kept, and the same command continues" in err
    finally:
        for process in (scheduler, worker):
            if process is not None:
                process.kill()
                process.wait()


def wait_for_server(port: int) -> None:
    """Returns when somebody listens at a port of this machine."""
    deadline = time.monotonic() + 60
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port)).close()
        except OSError:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def free_port() -> int:
    """A port of this machine that is free now."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]

"""How chunks are handed out: few at a time, to whoever is there; and what is said when that goes wrong."""

import logging
import signal
from concurrent.futures import Future
from contextlib import ExitStack
from types import SimpleNamespace

import pytest
from distributed import KilledWorker

import emt.cluster.connecting as connecting
import emt.cluster.pool as pools
from emt.cluster.connecting import find_scheduler, open_pool, uninterrupted
from emt.cluster.parcel import Parcel, ParcelError
from emt.cluster.pool import FEWEST, KEPT, PER_THREAD, ClusterError, Pool
from tests.cli.run_emt import emt
from tests.montecarlo.small import write

PARCEL = Parcel("small", "/small.yaml", {}, {}, "0", False, {})


class FakeClient:
    """Stands for the client of a cluster. Whenever the pool looks how many workers there are, the last task is done."""

    status = "running"

    def __init__(self):
        self.threads, self.flying, self.submitted, self.cancelled, self.most = 2, [], [], [], 0
        self.error = None

    def nthreads(self):
        if self.flying:
            future, result = self.flying.pop()
            if self.error is None:
                future.set_result(result)
            else:
                future.set_exception(self.error)
        return {f"tcp://worker-{k}": 1 for k in range(self.threads)}

    def submit(self, function, parcel, start, stop, tracked, **options):
        future = Future()
        self.flying.append((future, (start, stop)))
        self.submitted.append((start, stop, tracked))
        self.most = max(self.most, len(self.flying))
        return future

    def gather(self, futures):
        return [future.result() for future in futures]

    def cancel(self, futures, force):
        self.cancelled += futures


@pytest.fixture
def client(monkeypatch):
    monkeypatch.setattr(pools, "LOOK_SECONDS", 0.0)
    return FakeClient()


def pool_with(client) -> Pool:
    return Pool(client, "tcp://here:1", "", ExitStack())


def test_few_chunks_are_in_flight_and_all_come_back(client):
    ranges = [(k, k + 10) for k in range(0, 500, 10)]
    found = list(pool_with(client).run_chunks(PARCEL, ranges))
    assert all(result == (start, stop) for start, stop, result in found)
    assert sorted(result for *_, result in found) == ranges
    assert [result for *_, result in found] != ranges  # in the order they were ready
    assert client.most <= 2 * PER_THREAD
    assert client.submitted == [(start, stop, int(start == 0)) for start, stop in ranges]
    assert client.cancelled == []


def test_workers_may_come_later(client):
    client.threads = 0
    chunks = pool_with(client).run_chunks(PARCEL, ((k, k + 1) for k in range(100)))
    next(chunks)
    assert client.most == FEWEST
    client.threads = 5
    next(chunks)
    assert FEWEST < client.most <= 5 * PER_THREAD


def test_whoever_stops_early_leaves_no_task_behind(client):
    chunks = pool_with(client).run_chunks(PARCEL, ((k, k + 1) for k in range(100)))
    next(chunks)
    chunks.close()
    assert {future for future, _ in client.flying} <= set(client.cancelled)
    assert len(client.cancelled) == 2 * PER_THREAD - 1


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ParcelError("the worker on there has jax 1"), f"^the worker on there has jax 1; {KEPT}$"),
        (ZeroDivisionError("by zero"), f"^runs 10 to 19: ZeroDivisionError: by zero; {KEPT}$"),
        (
            KilledWorker("compute-1", SimpleNamespace(address="w"), 3),
            f"^runs 10 to 19: the workers .* died .*; {KEPT}$",
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_an_error_is_reported_once(client, error, message):
    """And not tried again: the same task would fail in the same way."""
    client.error = error
    with pytest.raises(ClusterError, match=message):
        next(pool_with(client).run_chunks(PARCEL, [(10, 20)]))
    assert len(client.submitted) == 1


def test_a_scheduler_that_is_gone_is_named(client):
    client.status = "closed"
    with pytest.raises(ClusterError, match=rf"the scheduler at tcp://here:1 is gone \(.*closed\); {KEPT}"):
        next(pool_with(client).run_chunks(PARCEL, [(0, 1)]))
    with pytest.raises(ClusterError, match="is gone"):
        pool_with(client).workers()


@pytest.mark.parametrize("address", ["", "nonsense", "tcp://host", "http://host:80", "tcp://a b:1", "tcp://h:1/x"])
def test_what_is_no_address_is_refused_at_once(address, tmp_path, capsys):
    refused = emt(capsys, "run", write(tmp_path), "--scheduler", address, "--out", tmp_path / "out")
    assert refused.code == 2
    assert f"{address!r} is not the address of a scheduler; expected tcp://HOST:PORT" in refused.err
    assert not (tmp_path / "out").exists()


def test_nobody_at_the_address(monkeypatch):
    monkeypatch.setattr(connecting, "CONNECT_SECONDS", 0.5)
    for address in ("tcp://127.0.0.1:1", "tcp://[::1]:1"):
        with pytest.raises(ClusterError, match="no scheduler answers at tcp://"):
            find_scheduler(address)


def test_options_exclude_one_another(tmp_path, capsys):
    refused = emt(capsys, "run", write(tmp_path), "--scheduler", "tcp://h:1", "--workers", "2")
    assert refused.code == 2
    assert "either --workers or --scheduler" in refused.err
    assert emt(capsys, "run", write(tmp_path), "--workers", "0").code == 2
    with pytest.raises(ClusterError, match="not both"):
        open_pool()


def test_the_extra_is_named_where_it_is_missing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(connecting, "is_installed", lambda name: False)
    refused = emt(capsys, "run", write(tmp_path), "--workers", "2", "--out", tmp_path / "out")
    assert refused.code == 2
    assert "pip install 'emt[cluster]'" in refused.err


def test_an_interruption_waits_until_processes_are_started():
    began = signal.getsignal(signal.SIGINT)
    done = []

    def start():
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            done.append(True)

    with pytest.raises(KeyboardInterrupt):
        start()
    assert done
    assert signal.getsignal(signal.SIGINT) is began
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, set())


def test_levels_of_logging_are_given_back():
    handlers = logging.getLogger("distributed").handlers
    before = [handler.level for handler in handlers]
    with connecting.quiet():
        assert all(handler.level > logging.CRITICAL for handler in handlers)
    assert [handler.level for handler in handlers] == before

"""From a number of workers or the address of a scheduler to a pool; and what Dask would say in between, unsaid."""

import asyncio
import importlib.util
import logging
import re
import signal
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
from typing import Any

from emt.cluster.pool import ClusterError, Pool
from emt.device import threads_of_each

CONNECT_SECONDS = 10.0
"""A scheduler that has not answered by then is taken to be absent."""
ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?(\[[^\s\]]+\]|[^\s/:]+):\d{1,5}/?")
NEEDED = ("distributed", "cryptography")
"""Packages of the extra `cluster`."""


def open_pool(*, workers: int | None = None, scheduler: str | None = None) -> Pool:
    """Starts worker processes here, or takes those of a running scheduler.

    Args:
        workers: number of processes, of one thread each; they end with the pool.
        scheduler: address such as `tcp://10.0.0.1:8786`, instead.

    Raises:
        ClusterError: `distributed` is missing, processes cannot be started, or nobody answers at the address.
    """
    if (workers is None) == (scheduler is None):
        raise ClusterError("give either a number of workers or the address of a scheduler, not both")
    missing = [name for name in NEEDED if not is_installed(name)]
    if missing:
        raise ClusterError(f"several processes need {' and '.join(missing)}: pip install 'emt[cluster]'")
    with ExitStack() as stack:
        stack.enter_context(quiet())
        cluster = scheduler if scheduler is not None else stack.enter_context(local_workers(workers or 1))
        client = stack.enter_context(connected(cluster))
        # without bokeh the page of the dashboard only says that bokeh is missing
        dashboard = client.dashboard_link if is_installed("bokeh") else None
        return Pool(client, client.scheduler.address, dashboard or "", stack.pop_all())


def is_installed(name: str) -> bool:
    """Whether a package can be imported."""
    return importlib.util.find_spec(name) is not None


@contextmanager
def quiet() -> Iterator[None]:
    """Leaves out what Dask logs of workers that die or end: what matters becomes an error or a result."""
    import distributed

    levels = {handler: handler.level for handler in logging.getLogger(distributed.__name__).handlers}
    for handler in levels:
        handler.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for handler, level in levels.items():
            handler.setLevel(level)


@contextmanager
def local_workers(n: int) -> Iterator[Any]:
    """A cluster of worker processes on this machine.

    Raises:
        ClusterError: they cannot be started.
    """
    from dask import config
    from distributed import LocalCluster

    options: Any = {"dashboard_address": "127.0.0.1:8787" if is_installed("bokeh") else None}
    with ExitStack() as stack:
        # what the scheduler remembers of tasks is of no use here, and would grow with the number of chunks
        stack.enter_context(config.set({"distributed.admin.low-level-log-length": 1000}))
        try:
            with uninterrupted(), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the usual port of the dashboard may be taken; another one will do
                made = LocalCluster(
                    n_workers=n,
                    threads_per_worker=1,
                    processes=True,
                    env=threads_of_each(n),
                    memory_limit=0,  # results do not stay with workers, and a limit would only stop them
                    security=True,  # other users of the machine could have their code run otherwise
                    silence_logs=logging.CRITICAL + 1,
                    **options,
                )
                cluster = stack.enter_context(made)
        except Exception as error:
            raise ClusterError(f"cannot start {n} workers: {type(error).__name__}: {error}") from error
        yield cluster


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Keeps Ctrl-C from processes and threads that are started meanwhile, and from this thread until the end.

    A terminal sends it to all processes; but workers end when this process tells them to.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # started by the first process otherwise, which ends the mask
    asked = []
    handler = signal.signal(signal.SIGINT, lambda *_: asked.append(True))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # threads and processes inherit the mask
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler or signal.default_int_handler)
        if asked:
            raise KeyboardInterrupt


@contextmanager
def connected(cluster: Any) -> Iterator[Any]:
    """A client of a scheduler, by its address or cluster.

    Raises:
        ClusterError: nobody answers, or not a scheduler.
    """
    from distributed import Client

    if isinstance(cluster, str):
        find_scheduler(cluster)
    try:
        client = Client(cluster, timeout=CONNECT_SECONDS, set_as_default=False)
    except Exception as error:
        raise ClusterError(f"cannot connect to the scheduler: {type(error).__name__}: {error}") from error
    with client:
        yield client


def find_scheduler(address: str) -> None:
    """Asks who is there: a client that finds nobody would take long to give up.

    Raises:
        ClusterError: not an address, or no scheduler answers there.
    """
    from distributed.core import rpc
    from distributed.security import Security

    async def ask() -> Any:
        security = Security().get_connection_args("client")
        async with rpc(address, timeout=CONNECT_SECONDS, connection_args=security) as server:
            return await server.identity()

    if not ADDRESS.fullmatch(address):
        raise ClusterError(f"{address!r} is not the address of a scheduler; expected tcp://HOST:PORT")
    try:
        with ThreadPoolExecutor(1) as thread:  # this one may have an event loop of its own, as in a notebook
            found = thread.submit(asyncio.run, asyncio.wait_for(ask(), CONNECT_SECONDS)).result()
        reason = "" if found["type"] == "Scheduler" else f"a {found['type']} does"
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".removesuffix(": ")
    if reason:
        raise ClusterError(f"no scheduler answers at {address} within {CONNECT_SECONDS:.0f} s ({reason})")

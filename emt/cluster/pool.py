"""The client's side: tasks are handed out a few at a time, and results come back in the order they are ready."""

import queue
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from itertools import islice
from typing import Any

from emt.cluster.parcel import Parcel, ParcelError

PER_THREAD = 4
"""Chunks handed out per thread of a worker: enough that none waits, few enough to hold the results in memory."""
FEWEST = 4
"""Chunks handed out while there is no worker yet."""
AT_ONCE = 16
"""Results that are fetched together, for the time on the way."""
LOOK_SECONDS = 1.0
"""Time after which workers are counted again."""
KEPT = "finished chunks are kept, and the same command continues"


class ClusterError(Exception):
    """The cluster cannot be used, or no longer; the text says why, and what is kept."""


class Pool:
    """Workers of a Dask cluster; made by `emt.cluster.connecting.open_pool`, used with `with`.

    Attributes:
        address: where the scheduler listens.
        dashboard: address of its dashboard, empty if there is none.
        most_workers: largest number of workers seen so far.
    """

    def __init__(self, client: Any, address: str, dashboard: str, stack: ExitStack):
        self._client, self._stack = client, stack
        self._places, self._looked = FEWEST, -LOOK_SECONDS
        self.address, self.dashboard, self.most_workers = address, dashboard, 0

    def __enter__(self) -> "Pool":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def workers(self) -> int:
        """Number of workers at present.

        Raises:
            ClusterError: the scheduler is gone.
        """
        return len(self._threads())

    def run_chunks(self, parcel: Parcel, ranges: Iterable[tuple[int, int]]) -> Iterator[tuple[int, int, Any]]:
        """(start, stop, `emt.cluster.tasks.Result`) of several chunks as they are ready; run 0 comes with tracks.

        A chunk whose worker dies is computed by another one; if that happens again and again, it is an error, as is
        whatever the computation itself raises.

        Raises:
            ClusterError: a chunk cannot be computed, or the scheduler is gone.
        """
        rest, flying = iter(ranges), {}
        ready: queue.SimpleQueue[Any] = queue.SimpleQueue()
        try:
            while True:
                for start, stop in islice(rest, max(self._count_places() - len(flying), 0)):
                    future = self._submit(parcel, start, stop)
                    flying[future] = (start, stop)
                    future.add_done_callback(ready.put)
                if not flying:
                    return
                # not too many, or workers would run out of chunks while these are stored
                done = taken(ready, min(self._places // PER_THREAD, AT_ONCE))
                yield from self._fetched({future: flying.pop(future) for future in done})
                del done  # so that workers forget them, too
        finally:
            with suppress(Exception):  # the scheduler may be gone
                self._client.cancel(list(flying), force=True)

    def _submit(self, parcel: Parcel, start: int, stop: int) -> Any:
        from emt.cluster.tasks import compute

        return self._client.submit(compute, parcel, start, stop, int(start == 0), pure=False, retries=0)

    def _fetched(self, done: dict[Any, tuple[int, int]]) -> Iterator[tuple[int, int, Any]]:
        """Chunks that are ready: fetched together or, if one of them failed, one after the other until it comes."""
        try:
            results = self._client.gather(list(done))
        except Exception:
            results = (self._result(future, start, stop) for future, (start, stop) in done.items())
        for (start, stop), result in zip(done.values(), results, strict=True):
            yield start, stop, result

    def _result(self, future: Any, start: int, stop: int) -> Any:
        from distributed import KilledWorker

        where = f"runs {start} to {stop - 1}"
        try:
            return future.result()
        except ParcelError as error:
            raise ClusterError(f"{error}; {KEPT}") from error
        except KilledWorker as error:
            died = "the workers that computed them died one after the other, perhaps for lack of memory"
            raise ClusterError(f"{where}: {died}; {KEPT}") from error
        except Exception as error:
            self._threads()  # if the scheduler is gone, that is the message
            raise ClusterError(f"{where}: {type(error).__name__}: {error}; {KEPT}") from error

    def _threads(self) -> dict[str, int]:
        """Threads of every worker."""
        try:
            if self._client.status != "running":
                raise ConnectionError(f"the connection is {self._client.status}")
            threads = self._client.nthreads()
        except Exception as error:
            raise ClusterError(f"the scheduler at {self.address} is gone ({error}); {KEPT}") from error
        self.most_workers = max(self.most_workers, len(threads))
        return threads

    def _count_places(self) -> int:
        """Chunks to have in work at a time; workers may come and go."""
        if time.monotonic() - self._looked >= LOOK_SECONDS:
            self._places = max(PER_THREAD * sum(self._threads().values()), FEWEST)
            self._looked = time.monotonic()
        return self._places


def taken(ready: "queue.SimpleQueue[Any]", most: int) -> list[Any]:
    """Waits for the first of a queue, though not long, and takes along what else is there."""
    found = []
    with suppress(queue.Empty):
        found.append(ready.get(timeout=LOOK_SECONDS))
        while len(found) < most:
            found.append(ready.get_nowait())
    return found

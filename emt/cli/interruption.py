"""Ctrl-C that is not lost."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def remembered() -> Iterator[Callable[[], None]]:
    """Gives a function to call now and then: it raises KeyboardInterrupt if the user asked for the end, once more.

    Python raises it wherever the main thread is, and drops whatever is raised while an object is finalised, as a future
    of Dask is for every chunk. Where Ctrl-C does something else, or this is not the main thread, nothing changes.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda: None
        return
    asked = False

    def remember(number, frame) -> None:
        nonlocal asked
        asked = True
        signal.default_int_handler(number, frame)

    def look() -> None:
        if asked:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, remember)
    try:
        yield look
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)

"""How many threads each of several processes is told to start."""

import pytest

from emt import device


@pytest.mark.parametrize(
    ("processors", "processes", "threads"), [(8, 2, "4"), (8, 3, "2"), (2, 2, "1"), (2, 5, "1"), (3, 1, "3")]
)
def test_processes_share_the_processors(monkeypatch, processors, processes, threads):
    monkeypatch.delenv("NPROC", raising=False)
    monkeypatch.setattr(device, "processors", lambda: processors)
    assert device.threads_of_each(processes) == {"NPROC": threads}


def test_what_the_user_set_stays(monkeypatch):
    monkeypatch.setenv("NPROC", "7")
    assert device.threads_of_each(2) == {}

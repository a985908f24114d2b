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


def test_threads_are_those_told_or_one_per_processor(monkeypatch):
    monkeypatch.setattr(device, "processors", lambda: 6)
    for told, threads in (("1", 1), ("4", 4), ("0", 1), ("many", 6), ("", 6)):
        monkeypatch.setenv("NPROC", told)
        assert device.threads() == threads
    monkeypatch.delenv("NPROC")
    assert device.threads() == 6


def test_what_the_user_set_stays(monkeypatch):
    monkeypatch.setenv("NPROC", "7")
    assert device.threads_of_each(2) == {}


def test_processors_of_one_name_are_told_apart(monkeypatch, tmp_path):
    """Virtual machines name a family; what a program is compiled for is in the numbers and instructions."""
    monkeypatch.setattr(device, "CPUINFO", tmp_path / "cpuinfo")
    names = set()
    for model, flags in (("1", "fpu avx avx2"), ("17", "fpu avx avx2 avx512f"), ("17", "fpu avx avx2")):
        block = f"processor\t: 0\ncpu family\t: 25\nmodel\t\t: {model}\nmodel name\t: AMD EPYC\nflags\t\t: {flags}\n\n"
        device.CPUINFO.write_text(block + block.replace("avx2", ""))
        names.add(device.cpu_name())
    assert names == {
        "AMD EPYC, family 25, model 1, avx2",
        "AMD EPYC, family 25, model 17, avx512f",
        "AMD EPYC, family 25, model 17, avx2",
    }


def test_a_system_that_tells_nothing_still_has_a_name(monkeypatch, tmp_path):
    monkeypatch.setattr(device, "CPUINFO", tmp_path / "none")
    assert isinstance(device.cpu_name(), str)
    (tmp_path / "none").write_text("Features : fp asimd\n")
    assert device.cpu_name().endswith(", asimd")

import os
import random
from contextlib import suppress
from itertools import count

import pytest

from emt.store.files import FileSystem, is_plain_name, make_folder, write_atomically
from tests.store.unreliable import ROOT, MemoryDisk, PowerCut, Unreliable, read_all, read_bytes

OLD, NEW = b"old content", b"new content, which is longer"


def test_replaces_content_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    for data in (OLD, NEW, b""):
        write_atomically(FileSystem(), path, data)
        assert path.read_bytes() == data
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]


def test_real_write_is_fsynced_before_its_name_and_the_name_after(tmp_path, monkeypatch):
    calls = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (calls.append("fsync"), fsync(fd)))
    monkeypatch.setattr(os, "replace", lambda a, b: (calls.append("replace"), replace(a, b)))
    write_atomically(FileSystem(), tmp_path / "a.txt", NEW)
    assert calls == ["fsync", "replace", "fsync"]


@pytest.mark.parametrize("failure", ["once", "always"])
@pytest.mark.parametrize("disk", ["memory", "real"])
def test_error_leaves_old_or_new(tmp_path, disk, failure):
    for n in count(1):
        inner, folder = (MemoryDisk(), ROOT) if disk == "memory" else (FileSystem(), tmp_path)
        write_atomically(inner, folder / "a.txt", OLD)
        fs = Unreliable(inner, n, failure)
        try:
            write_atomically(fs, folder / "a.txt", NEW)
            acknowledged = True
        except OSError:
            acknowledged = False
        found = read_all(inner, folder)
        assert found.pop("a.txt") in ([NEW] if acknowledged else [OLD, NEW])
        if failure == "once":
            assert not found  # the leftover is gone
        else:
            assert set(found) <= {"a.txt.partial"}
        if not fs.met:
            break
        write_atomically(inner, folder / "a.txt", NEW)  # also over a leftover
        assert read_all(inner, folder) == {"a.txt": NEW}
    assert n > 5


def test_full_disk_leaves_the_old_file(tmp_path):
    write_atomically(FileSystem(), tmp_path / "a.txt", OLD)
    for n in range(1, 6):  # create, write, fsync, close, rename
        with pytest.raises(OSError, match=r"No space|Input/output"):
            write_atomically(Unreliable(FileSystem(), n), tmp_path / "a.txt", NEW)
        assert read_all(FileSystem(), tmp_path) == {"a.txt": OLD}


@pytest.mark.parametrize("loss", ["names", "contents", "some"])
def test_power_cut_leaves_old_or_new(loss):
    rng = random.Random(0)
    for n in count(1):
        disk = MemoryDisk()
        write_atomically(disk, ROOT / "a.txt", OLD)
        fs = Unreliable(disk, n, "power cut")
        with suppress(PowerCut):
            write_atomically(fs, ROOT / "a.txt", NEW)
        disk.power_cut(loss, rng)
        assert read_bytes(disk, ROOT / "a.txt") in ([OLD, NEW] if fs.met else [NEW])
        if not fs.met:
            break


def test_leftover_that_is_a_link_is_not_followed(tmp_path):
    outside = tmp_path / "outside.txt"
    outside.write_bytes(OLD)
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "a.txt.partial").symlink_to(outside)
    write_atomically(FileSystem(), folder / "a.txt", NEW)
    assert outside.read_bytes() == OLD
    assert not (folder / "a.txt").is_symlink()


@pytest.mark.parametrize("loss", ["names", "some"])
def test_made_folders_survive_a_power_cut(loss):
    disk = MemoryDisk()
    make_folder(disk, ROOT / "a" / "b" / "c")
    disk.power_cut(loss, random.Random(0))
    assert disk.listdir(ROOT / "a" / "b") == ["c"]


def test_folder_found_is_made_safe_too():
    disk = MemoryDisk()
    disk.mkdir(ROOT / "a")  # by a process killed before it could sync
    disk.mkdir(ROOT / "a" / "b")
    make_folder(disk, ROOT / "a" / "b")
    disk.power_cut("names", random.Random(0))
    assert disk.listdir(ROOT / "a") == ["b"]


@pytest.mark.parametrize("name", ["summary.json", "table_2.tex", "a", "-x", "x" * 100, "A.B-c_9"])
def test_plain_names(name):
    assert is_plain_name(name)


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        ".hidden",
        "a/b",
        "a\\b",
        "../a",
        "/etc/passwd",
        "a\n",
        "a b",
        "a:b",
        "é",
        "x" * 101,
        "a.",
        "con",
        "NUL.txt",
        "com1",
        "a\0",
        "٣",
    ],
)
def test_other_names_are_refused(name):
    assert not is_plain_name(name)

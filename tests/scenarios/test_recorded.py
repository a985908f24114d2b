"""Recordings: both formats, and a helpful message for everything that can be wrong with a file."""

import hashlib
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.io import savemat

from emt.scenarios import data, recorded
from emt.scenarios.data import DataError
from emt.scenarios.recorded import RecordedSettings, read_scans
from tests.filters.cases import cast

SCANS = [np.array([[450.0, 240.0], [460.0, 250.5]]), np.zeros((0, 2)), np.array([[1.0, 2.0]])]
PARKING_LOT = Path(__file__).parents[3] / "shared" / "data" / "metu_parking_lot" / "measurements.mat"
PARKING_LOT_HASH = "265155cd0738961e3b461050f14d91f27ec2fe16155456ec1191cb6a1c6a2e21"


def cells(scans, dtype=np.float64):
    """The layout of a recording in MATLAB: a 1 x T cell array of 2 x n matrices."""
    array = np.empty((1, len(scans)), object)
    for k, scan in enumerate(scans):
        array[0, k] = np.asarray(scan, dtype).T
    return array


def write_mat(folder: Path, **variables) -> Path:
    file = folder / "scans.mat"
    savemat(file, variables)
    return file


def write_csv(folder: Path, text: str) -> Path:
    file = folder / "scans.csv"
    file.write_text(text, encoding="utf-8")
    return file


def settings_of(file, **changes) -> RecordedSettings:
    return RecordedSettings(path=str(file), dt=1.0, **changes)


def assert_scans(found, expected):
    assert len(found) == len(expected)
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.dtype == np.float64
        np.testing.assert_array_equal(ours, theirs)


def refusal(file, **changes) -> str:
    with pytest.raises(DataError) as caught:
        read_scans(settings_of(file, **changes))
    return str(caught.value)


def test_mat_file(tmp_path):
    assert_scans(read_scans(settings_of(write_mat(tmp_path, Z=cells(SCANS)))), SCANS)
    assert_scans(read_scans(settings_of(write_mat(tmp_path, W=cells(SCANS)), variable="W")), SCANS)


def test_column_of_cells(tmp_path):
    assert_scans(read_scans(settings_of(write_mat(tmp_path, Z=cells(SCANS).T))), SCANS)


def test_two_points_are_columns(tmp_path):
    """A 2 x 2 matrix is not transposed by guess."""
    assert_scans(read_scans(settings_of(write_mat(tmp_path, Z=cells(SCANS[:1])))), SCANS[:1])


def test_unsigned_integers_become_real_numbers(tmp_path):
    """Otherwise differences would wrap around: 1 - 2 = 65535."""
    found = read_scans(settings_of(write_mat(tmp_path, Z=cells([[[1, 2], [2, 1]]], np.uint16))))
    assert (found[0][0] - found[0][1]).tolist() == [-1.0, 1.0]


def test_csv_file(tmp_path):
    """Frames in any order, points in the order given, missing frames empty, the first frame of any number."""
    file = write_csv(tmp_path, "frame,x,y\n9,1,2\n7,450,240\n7,460,250.5\n")
    assert_scans(read_scans(settings_of(file)), SCANS)


def test_csv_with_more_columns(tmp_path):
    file = write_csv(tmp_path, "x,time,frame,y\n450,0.1,0,240\n")
    assert_scans(read_scans(settings_of(file)), [np.array([[450.0, 240.0]])])


def test_scenario_holds_the_recording(tmp_path):
    params, make = recorded.build(settings_of(write_mat(tmp_path, Z=cells(SCANS))), 1)
    scenario = make(cast(params, np.float64))
    key = jax.random.key(0)
    scans = scenario.sample_scans(scenario.sample_truth(key), key)
    assert np.asarray(scans.mask).tolist() == [[True, True], [False, False], [True, False]]
    np.testing.assert_array_equal(np.asarray(scans.points)[0], SCANS[0])
    assert not np.asarray(scans.overflow).any()
    np.testing.assert_array_equal(np.asarray(scenario.dt), np.ones(3))


def test_recording_of_empty_scans(tmp_path):
    """At least one slot, and nothing in it."""
    params, _ = recorded.build(settings_of(write_mat(tmp_path, Z=cells([np.zeros((0, 2))] * 2))), 1)
    assert params.points.shape == (2, 1, 2)
    assert not params.mask.any()


def test_expected_hash(tmp_path):
    file = write_mat(tmp_path, Z=cells(SCANS))
    right = hashlib.sha256(file.read_bytes()).hexdigest()
    assert_scans(read_scans(settings_of(file, sha256=right)), SCANS)
    wrong = "0" * 64
    message = refusal(file, sha256=wrong)
    assert right in message
    assert wrong in message
    assert "not the expected recording" in message


def test_no_file_given():
    with pytest.raises(DataError, match=r"scenario\.path=FILE"):
        read_scans(RecordedSettings(dt=1.0))


def test_missing_file(tmp_path):
    message = refusal(tmp_path / "absent.mat")
    assert "absent.mat" in message
    assert "No such file" in message


def test_folder_in_place_of_a_file(tmp_path):
    assert "directory" in refusal(tmp_path)


def test_unknown_format(tmp_path):
    file = tmp_path / "scans.xls"
    file.write_bytes(b"1")
    assert "unknown format '.xls' (known: .mat, .csv)" in refusal(file)


def test_too_large(tmp_path, monkeypatch):
    monkeypatch.setattr(data, "MAX_BYTES", 100)
    assert "is larger than" in refusal(write_mat(tmp_path, Z=cells(SCANS)))


@pytest.mark.parametrize("kept", [0, 1, 60, 127, 128, 140, 200, -60, -8, -1])
def test_truncated_mat_file(tmp_path, kept):
    """Anywhere: refused with the file's name, and never an empty recording."""
    file = write_mat(tmp_path, Z=cells(SCANS))
    file.write_bytes(file.read_bytes()[:kept])
    assert "scans.mat" in refusal(file)


def test_wrong_variable(tmp_path):
    message = refusal(write_mat(tmp_path, Y=cells(SCANS), W=np.eye(2)))
    assert "no variable 'Z'" in message
    assert "Y" in message
    assert "W" in message


def test_variable_that_is_no_cell_array(tmp_path):
    assert "not a cell array" in refusal(write_mat(tmp_path, Z=np.eye(2)))


@pytest.mark.parametrize(
    "bad",
    [np.zeros((3, 2)), np.array(["text"]), np.array([[1j, 1.0], [1.0, 2.0]]), np.zeros((2, 2, 2))],
    ids=["three rows", "text", "complex", "three dimensions"],
)
def test_cells_of_another_layout(tmp_path, bad):
    array = cells(SCANS)
    array[0, 1] = bad
    message = refusal(write_mat(tmp_path, Z=array))
    assert "scan 2" in message
    assert "2 x n" in message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("frame,x\n0,1\n", "no column y"),
        ("frame;x;y\n0;1;2\n", "no column"),
        ("frame,x,y\n0,1,abc\n", "column 'y'"),
        ("frame,x,y\nfirst,1,2\n", "column 'frame'"),
        ("frame,x,y\n0.5,1,2\n", "whole numbers"),
        ("frame,x,y\n,1,2\n", "whole numbers"),
        ("frame,x,y\n", ""),
        ("", "not a readable CSV file"),
        ("frame,x,y\n0,1,2,3,4\n1,1\n1,2,3,4,5,6\n", ""),
        ("frame,x,y\n0,1,2\n99999999999,1,2\n", "too long"),
        ("frame,x,y\n0,1,2\n1e300,1,2\n", "too long"),
        ("frame,x,y\n0,True,2\n", "column 'x'"),
    ],
)
def test_csv_files_that_cannot_be_used(tmp_path, text, expected):
    message = refusal(write_csv(tmp_path, text))
    assert "scans.csv" in message
    assert expected in message


def test_csv_of_bytes_that_are_no_text(tmp_path):
    file = tmp_path / "scans.csv"
    file.write_bytes(b"frame,x,y\n\xff\xfe\x00\n")
    assert "scans.csv" in refusal(file)


def test_parking_lot_recording():
    """105 frames of five points, stored as 16-bit integers."""
    if not PARKING_LOT.is_file():
        pytest.skip("the recording is not part of this checkout")
    scans = read_scans(settings_of(PARKING_LOT, sha256=PARKING_LOT_HASH))
    assert [len(scan) for scan in scans] == [5] * 105
    assert {scan.dtype for scan in scans} == {np.dtype(np.float64)}
    assert min(scan.min() for scan in scans) > 0.0
    spread = max(np.abs(np.diff(scan, axis=0)).max() for scan in scans)
    assert spread < 200.0, "differences wrapped around"

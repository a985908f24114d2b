"""Tracks from annotated boxes: what is read, and what is refused."""

import hashlib

import jax
import numpy as np
import pytest
from pydantic import ValidationError

from emt.scenarios.annotated import AnnotatedSettings, build, read_boxes
from emt.scenarios.data import DataError

DETECTIONS = {"count": {"kind": "fixed", "count": 300}, "source": "box", "noise_cov": {"diagonal": [0.0, 0.0]}}


def row(track, frame, lost=0, box=None, label='"Car"'):
    x = 10 * track + 2 * frame
    xmin, ymin, xmax, ymax = box or (x, 5, x + 40 + frame, 25)
    return f"{track} {xmin} {ymin} {xmax} {ymax} {frame} {lost} 0 1 {label}"


ROWS = (
    [row(3, f) for f in range(100, 110)] + [row(7, f, lost=int(f > 55)) for f in range(50, 60)] + [row(12, 4, lost=1)]
)


def settings(file, **changes):
    given = {"kind": "annotated", "path": str(file), "track": 3, "dt": 0.5, "detections": DETECTIONS} | changes
    return AnnotatedSettings.model_validate(given)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "annotations.txt"
    path.write_text("\n".join(ROWS[::-1]) + "\n")
    return path


def test_boxes_in_the_order_of_frames(file):
    boxes = read_boxes(settings(file))
    frames = np.arange(100, 110)
    np.testing.assert_array_equal(boxes[:, 0], 30 + 2 * frames)
    np.testing.assert_array_equal(boxes[:, 2] - boxes[:, 0], 40 + frames)
    assert read_boxes(settings(file, frames=(102, 107), every=2))[:, 0].tolist() == [234.0, 238.0, 242.0]
    assert len(read_boxes(settings(file, track=7))) == 6  # the lost frames at its end are no part of it


def test_truth_and_scans(file):
    params, make = build(settings(file), 4)
    scenario = make(jax.tree.map(np.asarray, params))
    truth = scenario.sample_truth(jax.random.key(0))
    np.testing.assert_allclose(truth.position[0], [30 + 200 + 70, 15.0])
    np.testing.assert_allclose(truth.velocity, np.tile([5.0, 0.0], (10, 1)))  # 2.5 pixels in half a second
    np.testing.assert_allclose(truth.ellipse.semi_axes[0], np.array([70.0, 10.0]) * np.sqrt(2.0))
    np.testing.assert_array_equal(truth.ellipse.orientation, 0.0)
    np.testing.assert_allclose(scenario.dt, 0.5)
    points = np.asarray(scenario.sample_scans(truth, jax.random.key(1)).points)[0] - np.asarray(truth.position[0])
    assert 69.0 < np.abs(points[:, 0]).max() <= 70.0
    assert 9.8 < np.abs(points[:, 1]).max() <= 10.0


@pytest.mark.parametrize(
    ("changes", "message", "key"),
    [
        ({"track": 2}, r"has no track 2 \(nearest: 3; it has 3\)", "track"),
        ({"track": 12}, "marked as lost in every frame", "track"),
        ({"track": 7, "frames": (50, 58)}, "has frames 50 to 55, but not 56, 57, 58", "frames"),
        ({"frames": (90, 101)}, "but not 90, 91, 92, 93, 94 and 5 more", "frames"),
        ({"frames": (100, 100)}, "at least 2 are needed", "frames"),
        ({"path": "nowhere.txt"}, "cannot read 'nowhere.txt'", "path"),
        ({"path": None}, "is required", "path"),
        ({"sha256": "0" * 64}, "is not the expected recording", "path"),
    ],
)
def test_refusals(file, changes, message, key):
    with pytest.raises(DataError, match=message) as error:
        read_boxes(settings(file, **changes))
    assert error.value.key == key


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a readable table"),
        ("1 2 3\n", "has 3 columns, expected 10: track xmin"),
        (row(3, 1).replace("3 ", "x ", 1) + "\n", "column 'track' holds something that is not a number"),
        ("\n".join([row(3, 1), row(3, 2), row(3, 2)]), "two boxes in one frame"),
        ("\n".join([row(3, 1), row(3, 2, box=(4, 5, 4, 9))]), "a box without area"),
        ("\n".join([row(3, 1), row(3, 3)]), "has frames 1 to 3, but not 2"),
        (b"\xff\xfe\x00\x81", "not a readable table"),
    ],
)
def test_damaged_files(tmp_path, text, message):
    path = tmp_path / "annotations.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DataError, match=message):
        read_boxes(settings(path))


def test_the_right_hash_is_accepted(file):
    assert len(read_boxes(settings(file, sha256=hashlib.sha256(file.read_bytes()).hexdigest()))) == 10


def test_frames_in_the_wrong_order():
    with pytest.raises(ValidationError, match="comes before the first"):
        settings("x", frames=(5, 4))

"""`emt verify`: golden vectors of other implementations, and what it says of files it cannot use."""

import json
from pathlib import Path

import numpy as np
import pytest

from emt.conformance.golden import GoldenError, verify
from emt.conformance.kinds import KINDS
from tests.cli.run_emt import emt
from tests.reference import moment_update_exact

EXCERPTS = sorted((Path(__file__).parents[1] / "golden").glob("*.json"))


@pytest.mark.parametrize("path", EXCERPTS, ids=lambda path: path.stem)
def test_excerpts_of_golden_vectors(path):
    """A few vectors of each kind travel with the project."""
    rows = verify(path, KINDS)
    assert rows
    assert [row for row in rows if not row.passed] == []


def test_moment_vectors_are_made_by_their_program():
    """Up to the last bits of the square roots, which NumPy's library makes, and what they become."""
    stored = json.loads(moment_update_exact.FILE.read_text())["cases"]
    for case, kept in zip(moment_update_exact.cases(), stored[:3], strict=False):
        assert case.keys() == kept.keys()
        for key, value in case.items():
            np.testing.assert_allclose(moment_update_exact.plain(value), kept[key], rtol=1e-11, atol=1e-14, err_msg=key)


FULL = [
    "vb_update",
    "mem_ekf_star",
    "feldmann_rm",
    "gp_ett",
    "ellipse_iou",
    "gaussian_wasserstein",
    "lcd_samples",
    "s2kf_updates",
]


@pytest.mark.parametrize("name", FULL)
def test_all_golden_vectors(golden, name):
    rows = verify(golden / f"{name}.json", KINDS)
    assert [row for row in rows if not row.passed] == []


def test_the_recorded_sequence(golden):
    data = golden.parent / "data" / "metu_parking_lot" / "measurements.mat"
    if not data.is_file():
        pytest.skip("the recording is not part of this checkout")
    rows = verify(golden / "real_data_vb_first20.json", KINDS, data)
    assert max(row.relative for row in rows) < 1e-9  # Gauss-Seidel order would show as 5e-9


@pytest.fixture
def changed(tmp_path):
    """A golden file with something changed."""

    def change(edit):
        content = json.loads(next(p for p in EXCERPTS if p.stem == "feldmann_rm").read_text())
        edit(content)
        path = tmp_path / "changed.json"
        path.write_text(json.dumps(content))
        return path

    return change


def test_a_wrong_number_is_found(changed, capsys):
    def edit(content):
        content["cases"][0]["x_upd"][0] *= 1 + 1e-8

    outcome = emt(capsys, "verify", changed(edit))
    assert outcome.code == 1
    assert next(line for line in outcome.out.splitlines() if "OUTSIDE" in line).startswith("position")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda c: c.update(kind="feldman_rm"), "did you mean 'feldmann_rm'?"),
        (lambda c: c.pop("kind"), "kind: is required"),
        (lambda c: c["cases"][0].pop("R"), "R: is required"),
        (lambda c: c["cases"][0].update(H=[[0, 1, 0, 0], [1, 0, 0, 0]]), "only H = [I 0] can be compared"),
        (lambda c: c.update(cases=[], sequences=[]), "holds no case"),
        (lambda c: c["cases"][0].update(y="points"), "not usable"),
    ],
)
def test_an_unusable_file_is_named(changed, capsys, edit, message):
    path = changed(edit)
    outcome = emt(capsys, "verify", path)
    assert outcome.code == 2
    assert message in outcome.err
    assert str(path) in outcome.err


@pytest.mark.parametrize("content", [b"{", b"\xff\xfe", b"[]", b"[" * 100_000])
def test_a_file_that_is_not_json_is_named(tmp_path, content):
    path = tmp_path / "broken.json"
    path.write_bytes(content)
    with pytest.raises(GoldenError, match=r"broken\.json"):
        verify(path, KINDS)


def test_a_recording_is_asked_for(capsys, tmp_path):
    path = tmp_path / "real.json"
    path.write_text(json.dumps({"kind": "real_data_vb"}))
    outcome = emt(capsys, "verify", path)
    assert outcome.code == 2
    assert "--data" in outcome.err

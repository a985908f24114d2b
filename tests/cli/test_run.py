"""`emt run`: results, continuation, extension, refusal."""

import json

import numpy as np
import pytest

from emt.store import read_folder
from tests.cli.run_emt import emt
from tests.montecarlo.small import TEXT, write


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished folder of the small experiment, run in pieces of its own."""
    folder = tmp_path_factory.mktemp("run")
    return write(folder), folder / "out"


@pytest.fixture
def done(finished, capsys):
    config, out = finished
    assert emt(capsys, "run", config, "--out", out).code == 0
    return config, out


def all_bytes(folder):
    """Every file that depends on the configuration only."""
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.suffix in (".npz", ".md", ".csv", ".png")} | {
        "summary.json": (folder / "summary.json").read_bytes()
    }


def test_a_run_leaves_table_figures_and_summary(done, capsys):
    _, out = done
    names = {path.name for path in out.iterdir()}
    assert {"summary.json", "table.md", "track.png", "over_time.png", "manifest.json"} <= names
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["experiment"], summary["runs"], summary["seed"]) == ("small", 40, 3)
    gw = summary["filters"]["feldmann"]["gw"]
    assert set(gw) == {"value", "se", "std", "median", "runs_used"}
    reader = read_folder(out)
    values = np.concatenate([reader.read_chunk(c)["feldmann/values"] for c in reader.chunks()])
    assert gw["value"] == pytest.approx(values[:, 0].mean(), rel=1e-12)
    assert gw["std"] == pytest.approx(values[:, 0].std(ddof=1), rel=1e-12)
    assert gw["median"] == pytest.approx(np.median(values[:, 0]), rel=1e-12)
    assert summary["filters"]["feldmann"]["gw_std"]["value"] == pytest.approx(gw["std"], rel=1e-12)
    shown = emt(capsys, "table", out)
    assert "feldmann" in shown.out
    assert "40/40" in shown.out


@pytest.mark.parametrize("fmt", ["text", "markdown", "latex", "csv", "json"])
def test_tables_in_every_format(done, capsys, fmt):
    _, out = done
    shown = emt(capsys, "table", out, "--format", fmt)
    assert shown.code == 0
    assert "feldmann" in shown.out
    if fmt == "json":
        assert json.loads(shown.out)["rows"][0]["metric"] == "gw"


def test_the_same_command_again_computes_nothing_and_changes_nothing(done, capsys):
    config, out = done
    before = all_bytes(out)
    assert emt(capsys, "run", config, "--out", out).code == 0
    assert all_bytes(out) == before


def test_a_removed_chunk_is_computed_again_to_the_bit(done, capsys):
    config, out = done
    before = all_bytes(out)
    (out / "chunk-000000016-000000032.npz").unlink()
    assert emt(capsys, "run", config, "--out", out).code == 0
    assert all_bytes(out) == before


def test_more_extends_without_computing_again(tmp_path, capsys):
    config = write(tmp_path)
    out = tmp_path / "out"
    assert emt(capsys, "run", config, "--out", out, "--runs", 20).code == 0
    first = (out / "chunk-000000000-000000016.npz").stat()
    assert emt(capsys, "run", config, "--out", out, "--runs", 20, "--more", 20).code == 0
    assert (out / "chunk-000000000-000000016.npz").stat().st_mtime_ns == first.st_mtime_ns
    summary = json.loads((out / "summary.json").read_text())
    assert summary["runs"] == 40
    whole = tmp_path / "whole"
    assert emt(capsys, "run", config, "--out", whole).code == 0
    other = json.loads((whole / "summary.json").read_text())
    assert other["filters"]["feldmann"]["gw"] == summary["filters"]["feldmann"]["gw"]
    ours, theirs = (
        np.concatenate([reader.read_chunk(c)["feldmann/values"] for c in reader.chunks()])
        for reader in (read_folder(out), read_folder(whole))
    )
    np.testing.assert_array_equal(ours, theirs)


def test_another_configuration_is_refused_and_named(done, capsys):
    config, out = done
    before = all_bytes(out)
    refused = emt(capsys, "run", config, "filters.feldmann.weight=9", "--out", out)
    assert refused.code == 2
    assert "filters.feldmann.weight" in refused.err
    assert all_bytes(out) == before


def test_title_and_comments_are_not_part_of_the_configuration(done, capsys, tmp_path):
    _, out = done
    other = write(tmp_path, "# a comment\n" + TEXT.replace("title: Small", "title: Renamed"))
    assert emt(capsys, "run", other, "--out", out).code == 0


def test_a_folder_of_something_else_is_left_alone(tmp_path, capsys):
    out = tmp_path / "mine"
    out.mkdir()
    (out / "thesis.tex").write_text("precious")
    refused = emt(capsys, "run", write(tmp_path), "--out", out)
    assert refused.code == 2
    assert [p.name for p in out.iterdir()] == ["thesis.tex"]


def test_replay_shows_the_run_of_the_table(done, capsys, tmp_path):
    config, out = done
    shown = emt(capsys, "replay", config, "--run", 21, "--out", tmp_path / "replay")
    assert shown.code == 0
    reader = read_folder(out)
    stored = np.concatenate([reader.read_chunk(c)["feldmann/values"] for c in reader.chunks()])[21]
    steps = (tmp_path / "replay" / "small-run21.csv").read_text().splitlines()
    header = steps[0].split(",")
    gw = [float(line.split(",")[header.index("gw")]) for line in steps[1:]]
    assert np.mean(gw) == pytest.approx(stored[0], rel=1e-13)
    assert (tmp_path / "replay" / "small-run21.png").read_bytes().startswith(b"\x89PNG")


def test_no_survivor_means_no_number_and_exit_1(tmp_path, capsys):
    outcome = emt(
        capsys,
        "run",
        write(tmp_path),
        "divergence={position_error_above: 1 mm}",
        "--out",
        tmp_path / "out",
        "--runs",
        9,
    )
    assert outcome.code == 1
    assert "no run survived for: feldmann" in outcome.err
    assert "0/9" in outcome.out
    gw = json.loads((tmp_path / "out" / "summary.json").read_text())["filters"]["feldmann"]["gw"]
    assert gw == {"value": None, "se": None, "std": None, "median": None, "runs_used": 0}

"""Bad input: all mistakes at once, with file, line and key; exit 2; nothing written."""

import pytest

from emt.config.shipped import BENCHMARK, config_names
from tests.cli.run_emt import emt
from tests.montecarlo.small import TEXT, write

MISTAKES = [
    ("title: Small", "titel: Small", "titel: not a known setting (did you mean 'title'?)"),
    ("runs: 40", "runs: 0", "monte_carlo.runs: must be greater than 0, got 0"),
    ("runs: 40", "runs: many", "monte_carlo.runs: expected a whole number"),
    ("seed: 3", "seed: true", "monte_carlo.seed: expected a whole number"),
    ("semi_axes: [10, 4]", "semi_axes: [10, -4]", "scenario.semi_axes[1]: must be greater than 0, got -4"),
    ("semi_axes: [10, 4]", "semi_axes: [10 kg, 4]", "'10 kg' is not a length"),
    ("[[0.5, 0.1], [0.1, 0.4]]", "[[-0.5, 0], [0, 1]]", "variance [0][0] must be at least 0"),
    ("[[0.5, 0.1], [0.1, 0.4]]", "[[0.5, 0.2], [0.1, 0.4]]", "not symmetric"),
    ("[[0.5, 0.1], [0.1, 0.4]]", "[[0.5, 9], [9, 0.4]]", "not positive"),
    ("psd: 0.01", "psd: .nan", "model.process_noise.psd: must be finite"),
    ("kind: feldmann", "kind: feldman", "did you mean 'feldmann'?"),
    ("metrics: [gw,", "metrics: [gww,", "did you mean 'gw'?"),
    ("metrics: [gw,", "metrics: [gw, gw,", "listed twice"),
    ("metrics:", "reference: vb\nmetrics:", "unknown reference 'vb'"),
    ("metrics:", "skip_steps: 4\nmetrics:", "must be less than the 4 steps"),
    ("metrics:", "sources: {calibrated: [model.pri]}\nmetrics:", "'model.pri' is not a setting of this file"),
    ("title: Small", "title: Small\ntitle: Large", "twice"),
    ("kind: stationary", "kind: !!python/name:os.system stationary", "tag"),
    ("feldmann: {", "fel dmann: {", "filters"),
    ("filters:", "filters: {}\nother:", "filters: needs at least 1"),
]


@pytest.mark.parametrize(("right", "wrong", "message"), MISTAKES, ids=[m[1][:40] for m in MISTAKES])
def test_a_mistake_is_named_with_its_line(tmp_path, capsys, right, wrong, message):
    assert right in TEXT
    config = write(tmp_path, TEXT.replace(right, wrong, 1))
    outcome = emt(capsys, "run", config, "--out", tmp_path / "out")
    assert outcome.code == 2
    assert message in outcome.err
    assert f"{config}:" in outcome.err
    assert outcome.err.split(f"{config}:")[1].split(":")[0].isdigit()
    assert "Traceback" not in outcome.err
    assert not (tmp_path / "out").exists()


def test_all_mistakes_are_named_at_once(tmp_path, capsys):
    text = TEXT.replace("runs: 40", "runs: 0").replace("psd: 0.01", "psd: -1")
    text = text.replace("metrics: [gw,", "metrics: [gww,")
    outcome = emt(capsys, "run", write(tmp_path, text))
    assert outcome.code == 2
    for key in ("monte_carlo.runs", "model.process_noise.psd", "metrics[0]"):
        assert key in outcome.err


def test_an_override_is_named_as_such(tmp_path, capsys):
    outcome = emt(capsys, "run", write(tmp_path), "filters.feldmann.wieght=3", "--out", tmp_path / "out")
    assert outcome.code == 2
    assert "command line: filters.feldmann.wieght" in outcome.err
    assert "did you mean 'weight'?" in outcome.err


def test_an_unknown_experiment_suggests_a_shipped_one(capsys):
    outcome = emt(capsys, "run", "tuncer2021/trajectory_unifrom")
    assert outcome.code == 2
    assert "did you mean 'tuncer2021/trajectory_uniform'?" in outcome.err


def test_an_unknown_paper_suggests_a_known_one(capsys):
    outcome = emt(capsys, "reproduce", "tuncer2012")
    assert outcome.code == 2
    assert "did you mean 'tuncer2021'?" in outcome.err


@pytest.mark.parametrize("content", [None, b"not a mat file", b""])
def test_a_recording_that_cannot_be_used_is_named(tmp_path, capsys, content):
    path = tmp_path / "scans.mat"
    if content is not None:
        path.write_bytes(content)
    outcome = emt(capsys, "run", "tuncer2021/parking_lot", f"scenario.path={path}", "--out", tmp_path / "out")
    assert outcome.code == 2
    assert "scenario.path" in outcome.err
    assert str(path) in outcome.err
    assert not (tmp_path / "out").exists()


def test_a_recording_must_be_given(tmp_path, capsys):
    outcome = emt(capsys, "run", "tuncer2021/parking_lot", "--out", tmp_path / "out")
    assert outcome.code == 2
    assert "scenario.path" in outcome.err


def test_a_recording_has_no_truth_to_compare_with(tmp_path, capsys):
    outcome = emt(capsys, "run", "tuncer2021/parking_lot", "metrics=[gw]", "--out", tmp_path / "out")
    assert outcome.code == 2
    assert "no ground truth" in outcome.err


def test_an_unwritable_folder_is_refused_before_anything_runs(tmp_path, capsys):
    blocked = tmp_path / "file"
    blocked.write_text("")
    outcome = emt(capsys, "run", write(tmp_path), "--out", blocked / "out")
    assert outcome.code == 2
    assert str(blocked) in outcome.err


def test_a_table_needs_a_run_folder(tmp_path, capsys):
    assert emt(capsys, "table", tmp_path).code == 2


@pytest.mark.parametrize("name", config_names())
def test_every_shipped_experiment_is_valid_and_can_be_shown(capsys, name):
    outcome = emt(capsys, "show", name)
    assert outcome.code == 0, outcome.err
    assert name.startswith(f"{BENCHMARK}/") or "calibrated" in outcome.out


def test_list_and_schema(capsys):
    listed = emt(capsys, "list")
    assert listed.code == 0
    assert "vb_random_matrix" in listed.out
    schema = emt(capsys, "schema")
    assert schema.code == 0
    assert '"vb_random_matrix"' in schema.out
    assert '"ConnectedModelSettings"' in schema.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rnu"], "No such command"),
        (["run"], "Missing argument"),
        (["run", "small", "--runs", "0"], "--runs"),
        (["run", "small", "--sed", "1"], "No such option"),
        (["reproduce", "--scale", "huge"], "--scale"),
    ],
)
def test_a_mistake_in_the_command_is_named(capsys, arguments, message):
    outcome = emt(capsys, *arguments)
    assert outcome.code == 2
    assert message in outcome.err


def test_help_and_version_end_well(capsys):
    assert emt(capsys, "--help").code == 0
    shown = emt(capsys, "run", "--help")
    assert shown.code == 0
    assert "Example: emt run" in shown.out
    assert emt(capsys, "--version").out.startswith("emt ")

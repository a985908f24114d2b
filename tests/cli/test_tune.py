"""`emt tune`: what it prints, writes and refuses."""

import csv

from emt.config.load import load_experiment
from tests.cli.run_emt import emt
from tests.montecarlo.small import TEXT, write

SMALL = ("--runs", "8", "--report-runs", "8")
COMMENTED = TEXT.replace("weight: 8,", "weight: 500,   ").replace("\nfilters:", "\n# of ours\nfilters:")


def test_tables_and_the_file(tmp_path, capsys):
    config = write(tmp_path, COMMENTED)
    table = tmp_path / "all.csv"
    done = emt(capsys, "tune", config, "filters.feldmann.weight=2,8", *SMALL, "--write", "--csv", table)
    assert done.code == 0
    for text in ("best of 3 candidates", "tuning (8)", "reporting (8)", "gw m", "compilation included"):
        assert text in done.out
    loaded = load_experiment(str(config))
    tuned = loaded.experiment.filters["feldmann"].weight
    assert tuned in (2.0, 8.0)
    assert loaded.experiment.sources.calibrated == ("filters.feldmann.weight",)
    text = config.read_text()
    assert text.startswith(COMMENTED.rstrip().replace("weight: 500,", f"weight: {int(tuned)},"))
    rows = list(csv.DictReader(table.open()))
    assert {float(row["filters.feldmann.weight"]) for row in rows} == {2.0, 8.0, 500.0}


def test_nothing_better_leaves_the_file(tmp_path, capsys):
    config = write(tmp_path)
    done = emt(capsys, "tune", config, "filters.feldmann.weight=8", *SMALL, "--write")
    assert done.code == 0
    assert "stays as it is" in done.err
    assert config.read_text() == TEXT


def test_refusals_come_before_any_run(tmp_path, capsys):
    config = write(tmp_path)
    for arguments, message in [
        ((config, "filters.feldmann.wight=1,2"), "did you mean 'weight'"),
        ((config, "filters.feldmann.weight=-1,2"), "filters.feldmann.weight"),
        ((config, "filters.feldmann.weight", "--objective", "iuo"), "did you mean 'iou'"),
        ((config, "filters.feldmann.weight", "--csv", tmp_path / "no" / "a.csv"), "there is no folder"),
        ((config, "filters.feldmann.weight", "--set", "skip_steps=1", "--write"), "nothing written"),
        (("yao2020/linear", "filters.lan_li.psd", "--write"), "is shipped with emt"),
        (("nowhere", "filters.feldmann.weight"), "neither a file nor a shipped experiment"),
    ]:
        done = emt(capsys, "tune", *arguments, *SMALL)
        assert done.code == 2, arguments
        assert message in done.err, arguments
        assert done.out == ""
    assert config.read_text() == TEXT

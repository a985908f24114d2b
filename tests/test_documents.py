"""README, notes and tracked tables say what is so."""

import re
import shlex
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emt.config.load import load_experiment
from emt.montecarlo.chunks import Engine
from emt.montecarlo.program import Program
from emt.tuning.parameters import candidate, combinations, label_of, parse_parameters

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def block(language: str, containing: str = "") -> str:
    """The first code block of a language in README that contains a text."""
    return next(text for text in re.findall(rf"```{language}\n(.*?)```", README, re.S) if containing in text)


def engine_of(path: Path, runs: int, *overrides: str) -> Engine:
    """A compiled engine for the experiment of a file, with so many runs in a chunk."""
    experiment = load_experiment(str(path), overrides).experiment
    with jax.numpy_dtype_promotion("standard"):
        engine = Engine(Program.of(experiment), 1, runs)
        engine.compile()
    return engine


@pytest.fixture
def beside(tmp_path, monkeypatch):
    """The folder in which a reader of README writes experiment and filter."""
    (tmp_path / "mine.yaml").write_text(block("yaml"), encoding="utf-8")
    (tmp_path / "nearest.py").write_text(block("python", "NearestSettings"), encoding="utf-8")
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


def test_the_experiment_in_readme_is_valid(beside):
    experiment = load_experiment(str(beside / "mine.yaml")).experiment
    assert experiment.scenario.n_steps == 80
    assert experiment.scenario.speed == pytest.approx(60 / 3.6)


def test_the_connected_object_in_readme_is_tracked(tmp_path):
    """The robust filter finds the length of the boom, from 3 m to 4 m."""
    text = block("yaml", "A digger")
    path = tmp_path / "digger.yaml"
    path.write_text(re.sub(r"  plain: .*\n", "", text), encoding="utf-8")
    engine = engine_of(path, 8, "scenario.steps=400", "monte_carlo={runs: 8, chunk: 8}")
    assert engine.labels() == ["robust"]
    values = engine.run_chunk(0, 8)["robust/values"]
    assert np.median(values[:, 0]) < 0.2
    assert np.median(values[:, 3]) < 0.2


def test_the_diver_in_readme_is_tracked_through_the_turn(tmp_path, monkeypatch):
    """The measurement is a function beside the file; the filter with several motions finds the turn."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "buoys.py").write_text(block("python", "buoys.py"), encoding="utf-8")
    path = tmp_path / "sonar.yaml"
    path.write_text(re.sub(r"  ukf: .*\n", "", block("yaml", "A diver")), encoding="utf-8")
    engine = engine_of(path, 16)
    arrays = engine.run_chunk(0, 16)
    ekf, imm = (arrays[f"{label}/values"] for label in ("ekf", "imm"))
    assert np.mean(imm[:, 0]) < 0.6 * np.mean(ekf[:, 0])
    assert np.mean(imm[:, 4]) > 0.6
    assert not arrays["imm/status"].any()


def test_the_filter_in_readme_works_like_any_other(beside):
    text = block("yaml").replace("metrics: [", "  nearest: {kind: 'nearest:NearestSettings', size: 6 m}\nmetrics: [")
    text = re.sub(r"  (vb|vb_3|feldmann): .*\n", "", text).replace("runs: 500", "chunk: 16, runs: 500")
    path = beside / "plugin.yaml"
    path.write_text(text, encoding="utf-8")
    engine = engine_of(path, 16)
    assert engine.labels() == ["nearest"]
    arrays = engine.run_chunk(0, 16)
    assert not arrays["nearest/status"].any()
    nees = arrays["nearest/values"][:, 4]
    assert 0.5 < np.mean(nees) < 8.0
    assert jnp.isfinite(arrays["nearest/values"]).all()


def test_the_searches_in_readme_are_possible(beside):
    loaded = load_experiment(str(beside / "mine.yaml"))
    commands = [shlex.split(line, comments=True)[2:] for line in README.splitlines() if "emt tune mine.yaml" in line]
    assert len(commands) == 3
    for command in commands:
        named = [text for text in command[1:] if "." in text]
        grid = "gradient" not in command
        parameters = parse_parameters(named, loaded, grid)
        assert label_of(parameters, "vb" if "--filter" in command else None, loaded) in ("vb", "vb_3")
        points = combinations(parameters) if grid else []
        for values in points[:1] + points[-1:]:
            candidate(loaded, parameters, values)


def test_the_excerpt_in_readme_stands_in_the_report():
    excerpt = README.split("<!-- excerpt -->")[1].split("<!-- /excerpt -->")[0].strip().splitlines()
    report = (ROOT / "results" / "tables" / "tuncer2021.md").read_text(encoding="utf-8")
    assert len(excerpt) > 5
    for line in excerpt:
        assert line in report


def test_the_guide_in_readme_is_that_of_the_report():
    guide = README.split("<!-- guide -->")[1].split("<!-- /guide -->")[0].strip().splitlines()
    report = (ROOT / "results" / "tables" / "azimian2005.md").read_text(encoding="utf-8")
    assert len(guide) > 8
    for line in guide:
        assert line in report


def test_every_number_is_that_of_the_other_implementation():
    """All within 4 combined standard errors or 5 %; what is quoted from memory stays without a verdict."""
    report = (ROOT / "results" / "tables" / "azimian2005.md").read_text(encoding="utf-8")
    tables = [part for part in report.split("\n**") if part.startswith("Experiment")]
    verdicts = [row.split("|")[-3].strip() for part in tables for row in part.splitlines() if row.count("|") == 10]
    assert verdicts.count("agrees") + verdicts.count("close") > 100
    assert verdicts.count("not confirmed") == 15
    assert set(verdicts) <= {"agrees", "close", "not confirmed", "verdict", "---"}


@pytest.mark.parametrize("paper", ["zea2014", "azimian2005"])
def test_every_claim_that_does_not_hold_has_a_sentence(paper):
    """One row of notes.md for each claim whose verdict is not `holds`, where papers have no numbers to explain."""
    notes = (ROOT / "experiments" / paper / "notes.md").read_text(encoding="utf-8")
    report = (ROOT / "results" / "tables" / f"{paper}.md").read_text(encoding="utf-8").split("**Claims")[1]
    rows = [[cell.strip() for cell in line.split("|")] for line in report.splitlines() if line.startswith("| ")]
    open_claims = [row[1] for row in rows if row[3] in ("undecided", "does not hold", "not comparable")]
    assert open_claims
    for claim in open_claims:
        assert f"| {claim} |" in notes, claim


def test_pictures_of_readme_and_reports_exist():
    for document in (ROOT / "README.md", *(ROOT / "results" / "tables").glob("*.md")):
        for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", document.read_text(encoding="utf-8")):
            assert (document.parent / target).is_file(), target


def with_printed_numbers():
    """Reports of the papers that print numbers."""
    reports = sorted((ROOT / "results" / "tables").glob("*2*.md"))
    return [report for report in reports if "| published |" in report.read_text(encoding="utf-8")]


@pytest.mark.parametrize("report", with_printed_numbers(), ids=lambda p: p.stem)
def test_every_number_that_does_not_agree_has_a_sentence(report):
    """One row of notes.md for each published cell whose verdict is not `agrees`."""
    notes = (ROOT / "experiments" / report.stem / "notes.md").read_text(encoding="utf-8")
    explained = {tuple(c.strip() for c in line.split("|")[1:5]) for line in notes.splitlines() if line.startswith("| ")}
    found = 0
    title = ""
    for line in report.read_text(encoding="utf-8").splitlines():
        if line.startswith("**"):
            named = re.match(r"\*\*(Table \w+|Section [\w-]+(?:, tuned)?)", line)
            title = named[1] if named else ""
        cells = [cell.strip() for cell in line.split("|")]
        verdicts = {"close", "differs", "not comparable"}
        if title and len(cells) > 9 and cells[8] in verdicts:
            found += 1
            assert (title, cells[1], cells[2], cells[4]) in explained, line
    assert found

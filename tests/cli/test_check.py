"""`emt check`: exit 0 where nothing moved, 1 with a table of what did, 2 without a usable baseline."""

import json

import pytest

from tests.cli.run_emt import emt
from tests.montecarlo.small import TEXT, write


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """(configuration, folder of baselines), the baseline still to be written."""
    folder = tmp_path_factory.mktemp("check")
    return write(folder), folder / "baselines"


@pytest.fixture
def baseline(stored, capsys):
    config, folder = stored
    assert emt(capsys, "check", config, "--baselines", folder, "--update").code == 0
    return config, folder / "small.json"


def change(path, edit):
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def test_nothing_moved(baseline, capsys):
    config, path = baseline
    outcome = emt(capsys, "check", config, "--baselines", path.parent)
    assert outcome.code == 0
    assert "every metric" in outcome.out


def test_a_metric_that_moved_is_shown(baseline, capsys):
    config, path = baseline
    change(
        path,
        lambda c: c["filters"]["feldmann"]["gw"].update(value=c["filters"]["feldmann"]["gw"]["value"] * (1 + 1e-8)),
    )
    outcome = emt(capsys, "check", config, "--baselines", path.parent)
    assert outcome.code == 1
    moved = [line for line in outcome.out.splitlines() if line.startswith("small")]
    assert len(moved) == 1
    assert "gw" in moved[0]


def elsewhere(content, errors):
    """A baseline of another platform, `errors` standard errors away in one metric."""
    content["platform"]["machine"] = "another"
    gw = content["filters"]["feldmann"]["gw"]
    gw["value"] += errors * 2**0.5 * gw["se"]


@pytest.mark.parametrize(("errors", "code"), [(3.5, 0), (4.5, 1)])
def test_another_platform_is_compared_by_standard_errors(baseline, capsys, errors, code):
    config, path = baseline
    change(path, lambda content: elsewhere(content, errors))
    assert emt(capsys, "check", config, "--baselines", path.parent).code == code


def test_a_change_of_the_configuration_is_seen(baseline, capsys, tmp_path):
    _, path = baseline
    other = write(tmp_path, TEXT.replace("weight: 8", "weight: 9"))
    assert emt(capsys, "check", other, "--baselines", path.parent).code == 1


def test_a_filter_that_is_new_is_shown(baseline, capsys):
    config, path = baseline
    change(path, lambda c: c["filters"].clear())
    outcome = emt(capsys, "check", config, "--baselines", path.parent)
    assert outcome.code == 1
    assert "new" in outcome.out


@pytest.mark.parametrize("content", [None, "{", "{}"])
def test_a_missing_or_damaged_baseline_is_named(baseline, capsys, content):
    config, path = baseline
    path.unlink()
    if content is not None:
        path.write_text(content)
    outcome = emt(capsys, "check", config, "--baselines", path.parent)
    assert outcome.code == 2
    assert "--update" in outcome.err

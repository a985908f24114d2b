"""Experiments on connected objects from the command line: a run, its replay, and what cannot be run."""

import json

import numpy as np
import pytest
from PIL import Image

from emt.config.errors import ConfigError
from emt.config.load import at_smoke_scale, load_experiment
from emt.config.shipped import config_path
from emt.status import Status
from emt.store import read_folder
from tests.cli.run_emt import emt

SMALL = (
    "scenario.steps=80",
    "skip_steps=20",
    "monte_carlo={runs: 6, chunk: 4, seed: 2}",
    "divergence={final_mean_above: {length_a_error: 0.2}, last_steps: 20, exclude: false}",
    "filters={weighted: {kind: shape_mixture, samples: {count: 18}}}",
)


def test_a_run_its_tables_figures_and_replay(tmp_path, capsys):
    outcome = emt(capsys, "run", "zea2014/scenario_a", *SMALL, "--out", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    found = summary["filters"]["weighted"]
    assert found["alpha_a_error"]["runs_used"] == 6  # lost runs stay
    values = read_folder(tmp_path / "out").read_chunk(read_folder(tmp_path / "out").chunks()[0])
    lost = (values["weighted/status"] & int(Status.LOST)) != 0
    names = [metric["name"] for metric in summary["metrics"]]
    np.testing.assert_array_equal(values["weighted/values"][:, names.index("lost")], lost)
    assert lost.any()
    units = {metric["name"]: metric["unit"] for metric in summary["metrics"]}
    assert (units["length_a_error"], units["alpha_a_error"]) == ("L", "rad")
    with Image.open(tmp_path / "out" / "animation.gif") as movie:
        assert movie.n_frames > 20
    assert (tmp_path / "out" / "track.png").stat().st_size > 20_000
    assert (tmp_path / "out" / "over_time.png").stat().st_size > 20_000
    table = emt(capsys, "table", tmp_path / "out", "--format", "markdown")
    assert "medians over 6 runs" in table.out
    outcome = emt(capsys, "replay", "zea2014/scenario_a", *SMALL, "--run", "5", "--out", tmp_path / "again")
    assert outcome.code == 0, outcome.err
    files = list((tmp_path / "again").iterdir())
    steps = next(file for file in files if file.suffix == ".csv").read_text().splitlines()
    assert steps[0].startswith("filter,scan,length_a,alpha_a,alpha_a_rate,length_b")
    assert len(steps) == 81


MISTAKES = [
    ("angle: {alpha_b: 1.0}", "angle: {alpha_x: 1.0}", "unknown parameter 'alpha_x'"),
    ("after: upper", "after: finger_1", "is a circle"),
    ("radius: 0.3", "radius: -0.3", "must be greater than 0, got -0.3"),
    ("lengths: {length_a: 0.5, length_b: 0.5}", "lengths: {length_a: 0.5}", "prior.lengths: no value for length_b"),
    ("samples: {count: 32}", "samples: {count: 17}", "17 samples are fewer than twice their dimension, 2 x 9"),
    ("samples: {count: 32}", "samples: {rule: cubature, count: 32}", "the cubature rule has a count of its own"),
    ("samples: {count: 32}", "probabilities: {hub: 1.0}", "no probability for upper"),
    ("samples: {count: 32}", "markov: {stay: 0.5}, gate: 0.9", "gate: a Markov switch has none"),
    (
        "{kind: shape_mixture, samples: {count: 32}}",
        "{kind: feldmann, weight: 30, decay: {kind: inverse_wishart, factor: 0.99}}",
        "'feldmann' is about an ellipse, the model about a connected object",
    ),
    ("  - shape_distance", "  - iou", "no filter of this experiment has 'iou'"),
    ("  - shape_distance", "  - beta_error", "no filter of this experiment has 'beta_error'"),
    ("    length_a_error: 0.5", "    gw: 0.5", "divergence.final_mean_above.gw: is not among the metrics"),
    ("start_with:", "reference: weighted\nstart_with:", "a connected object is compared with the truth only"),
    ("  noise_cov: {diagonal: [1.0e-2, 1.0e-2]}\n  prior", "  noise_cov: {diagonal: [1, 2]}\n  prior", "not isotropic"),
    ("kind: connected\n  shape: *object", "kind: conected\n  shape: *object", "model"),
    ("variance: {length: 1.0e-3", "variance: {length: 0", "must be positive for every entry"),
]


@pytest.mark.parametrize(("right", "wrong", "message"), MISTAKES, ids=[m[2][:40] for m in MISTAKES])
def test_a_mistake_is_named_with_its_line(tmp_path, capsys, right, wrong, message):
    text = config_path("zea2014/scenario_a").read_text(encoding="utf-8")
    assert right in text
    config = tmp_path / "arm.yaml"
    config.write_text(text.replace(right, wrong, 1), encoding="utf-8")
    outcome = emt(capsys, "run", config, *SMALL[:3], "--out", tmp_path / "out")
    assert outcome.code == 2
    assert message in outcome.err
    assert "Traceback" not in outcome.err
    assert not (tmp_path / "out").exists()


def test_an_ellipse_filter_does_not_take_a_connected_object(tmp_path, capsys):
    text = config_path("zea2014/scenario_a").read_text(encoding="utf-8")
    config = tmp_path / "arm.yaml"
    config.write_text(text.replace("final_mean_above:", "position_error_above: 3.0\n  final_mean_above:", 1))
    outcome = emt(capsys, "run", config, "--out", tmp_path / "out")
    assert outcome.code == 2
    assert "divergence.position_error_above: this object has no position" in outcome.err


def test_smoke_scale_has_fewer_steps():
    loaded = load_experiment("zea2014/scenario_a")
    small = at_smoke_scale(loaded)
    assert small.experiment.scenario.steps < loaded.experiment.scenario.steps == 12_600
    assert small.experiment.monte_carlo.runs == loaded.experiment.monte_carlo.smoke_runs
    assert small.name == loaded.name


def test_smoke_scale_may_have_fewer_filters():
    assert list(at_smoke_scale(load_experiment("zea2014/association")).experiment.filters) == [
        "printed_disc",
        "augmented",
    ]
    renamed = load_experiment("zea2014/association", ["monte_carlo.smoke_filters=[augmentd]"])
    with pytest.raises(ConfigError, match="did you mean 'augmented'"):
        at_smoke_scale(renamed)

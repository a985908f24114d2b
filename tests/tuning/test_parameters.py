"""What `emt tune` understands by a parameter."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emt.config.errors import ConfigError
from emt.config.load import load_experiment
from emt.tuning.parameters import Parameter, candidate, combinations, label_of, parse_parameters

M = "filters.ukf_imm.modes.*.moment_cov"


@pytest.fixture(scope="module")
def loaded():
    return load_experiment("yao2020/complex")


def test_a_group_stands_for_each_of_its_numbers(loaded):
    found = parse_parameters(["filters.ukf_ct.moment_cov"], loaded, grid=False)
    assert [(p.name, p.start) for p in found] == [
        (f"filters.ukf_ct.moment_cov.diagonal[{k}]", start) for k, start in enumerate((1e6, 1000.0, 1000.0))
    ]


def test_a_star_ties_numbers(loaded):
    first, second, third = parse_parameters([M], loaded, grid=False)
    assert first.paths == tuple(
        ("filters", "ukf_imm", "modes", mode, "moment_cov", "diagonal", 0) for mode in ("cv", "ct")
    )
    modes = candidate(loaded, [first, second, third], [3.0, 4.0, 5.0]).experiment.filters["ukf_imm"].modes
    assert {mode.moment_cov for mode in modes.values()} == {((3.0, 0.0, 0.0), (0.0, 4.0, 0.0), (0.0, 0.0, 5.0))}
    assert loaded.experiment.filters["ukf_imm"].modes["cv"].moment_cov[0][0] == 1e6


def test_units_are_kept(loaded):
    (found,) = parse_parameters(["filters.ukf_ct.motion.turn_acceleration_variance"], loaded, grid=False)
    assert (found.start, found.unit) == (0.0004, " deg^2/s^4")
    settings = candidate(loaded, [found], [0.0008]).experiment.filters["ukf_ct"]
    assert settings.motion.turn_acceleration_variance == pytest.approx(0.0008 * math.radians(1) ** 2, rel=1e-12)


def test_grids(loaded):
    psd, ratio, kappa = parse_parameters(
        ["filters.ukf_imm.modes.cv.motion.psd", f"{M[:-10]}projection.ratio=0.01:1:3", f"{M[:-10]}kappa=-6,0"],
        loaded,
        True,
    )
    assert psd.values == (0.001, 0.003162, 0.01, 0.03162, 0.1)
    assert ratio.values == (0.01, 0.1, 1.0)
    assert kappa.values == (-6, 0)
    assert len(combinations([psd, ratio, kappa])) == 30
    (linear,) = parse_parameters([f"{M[:-10]}kappa=-6:0:3"], loaded, True)
    assert linear.values == (-6.0, -3.0, 0.0)


@given(st.floats(0.02, 40.0), st.booleans())
def test_coordinates_go_there_and_back(value, bounded):
    parameter = Parameter("a", (), 1.0, "", (0.01, 50.0) if bounded else None, None)
    assert parameter.value(parameter.theta(value)) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("filters.ukf_ct.moment_co", r"gives no 'moment_co' \(did you mean 'moment_cov'"),
        ("filters.ukf_ct.moment_cov.diagonal[3]", "gives no '3'"),
        ("filters.ukf_ct.kind", "is 'moment_ukf', not a number"),
        ("filters.ukf_ct.kappa", "is -6, not positive: give LOW:HIGH or values"),
        ("filters.ukf_ct.kappa=1:0", "expected LOW < HIGH"),
        ("filters.ukf_ct.kappa=1:2:3:4", "expected LOW < HIGH"),
        ("filters.ukf_ct.kappa=a:b", "expected LOW:HIGH or LOW:HIGH:COUNT"),
        ("filters.*.modes", "gives no 'modes'"),
        ("filters.ukf_imm.modes.*.moment_cov.diagonal.*", "the numbers to tie differ"),
        ("scenario.dt", "only settings under filters and model"),
        ("monte_carlo.runs=1,2", "only settings under filters and model"),
        ("", "no key given"),
    ],
)
def test_refusals(loaded, text, message):
    with pytest.raises(ConfigError, match=message):
        parse_parameters([text], loaded, grid=True)


def test_refusals_of_a_gradient(loaded):
    with pytest.raises(ConfigError, match="values are for --method grid"):
        parse_parameters(["filters.ukf_ct.kappa=1,2"], loaded, grid=False)
    with pytest.raises(ConfigError, match="outside 0:1"):
        parse_parameters(["filters.ukf_ct.kappa=0:1"], loaded, grid=False)


def test_a_key_named_twice(loaded):
    with pytest.raises(ConfigError, match=r"filters\.ukf_ct\.projection\.ratio: is named twice"):
        parse_parameters(["filters.ukf_ct.projection.ratio", "filters.ukf_ct.projection"], loaded, grid=True)


def test_one_filter_at_a_time(loaded):
    ct = parse_parameters(["filters.ukf_ct.projection.floor"], loaded, grid=True)
    told = parse_parameters(["model.noise_cov.diagonal.*"], loaded, grid=True)
    assert label_of(ct, None, loaded) == "ukf_ct"
    assert label_of(told, "lan_li_imm", loaded) == "lan_li_imm"
    for wrong, label in [(told, None), (ct, "ukf_imm")]:
        with pytest.raises(ConfigError, match="one filter is tuned at a time"):
            label_of(wrong, label, loaded)
    with pytest.raises(ConfigError, match="did you mean 'ukf_ct'"):
        label_of(told, "ukf_cz", loaded)


def test_too_many_candidates(loaded):
    found = parse_parameters(["filters.ukf_ct.moment_cov=1:10:30"], loaded, grid=True)
    with pytest.raises(ConfigError, match="the grid has 27000 points"):
        combinations(found)


def test_an_invalid_value_names_its_line(loaded):
    (found,) = parse_parameters(["filters.ukf_ct.projection.ratio=0.5,1.5"], loaded, grid=True)
    with pytest.raises(ConfigError, match=r"complex\.yaml:\d+: filters\.ukf_ct\.projection\.ratio: .*1\.5"):
        candidate(loaded, [found], [1.5])

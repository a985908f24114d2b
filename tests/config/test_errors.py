"""Mistakes in the user's words: his keys, his lines, what would be right, all at once."""

from typing import Annotated, Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import AfterValidator, Field, PositiveInt, Tag, field_validator, model_validator
from pydantic.types import Discriminator

from emt.config.errors import COMMAND_LINE, ConfigError, Problem, dotted, validate
from emt.config.source import parse_source
from emt.settings import Covariance2, Duration, Fraction, PositiveLength, Quantity, Settings, Speed


class Straight(Settings):
    kind: Literal["straight"] = "straight"
    speed: Speed
    duration: Duration = 10.0


class Turn(Settings):
    kind: Literal["turn"] = "turn"
    rate: Annotated[float, Quantity("rad/s")]
    straight: bool = False


class VbRandomMatrix(Settings):
    kind: Literal["vb_random_matrix"] = "vb_random_matrix"
    iterations: Annotated[int, Field(ge=1, le=100)] = 10
    forgetting: Fraction = 0.9


class Feldmann(Settings):
    kind: Literal["feldmann"] = "feldmann"
    cov: Covariance2 = ((1.0, 0.0), (0.0, 1.0))

    @model_validator(mode="after")
    def _narrow(self):
        if self.cov[0][0] > 100:
            raise ValueError("cov is wider than the scene")
        return self


class MonteCarlo(Settings):
    runs: PositiveInt = 100
    seed: int = 0


Leg = Annotated[Straight | Turn, Field(discriminator="kind")]


class Foreign(Settings):
    kind: str
    gain: Fraction = 0.5


def _kind(value: Any) -> Any:
    return value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)


Tagged = Annotated[
    Annotated[Straight, Tag("straight")] | Annotated[Turn, Tag("turn")] | Annotated[Foreign, Tag("mine:X")],
    Field(discriminator=Discriminator(_kind)),
]


class Experiment(Settings):
    name: Annotated[str, Field(pattern=r"^[a-z]+$")] = "x"
    legs: tuple[Leg, ...] = ()
    tagged: tuple[Tagged, ...] = ()
    filters: dict[str, Annotated[VbRandomMatrix | Feldmann, Field(discriminator="kind")]] = Field(default={})
    monte_carlo: MonteCarlo = MonteCarlo()
    size: tuple[PositiveLength, PositiveLength] = (4.5, 2.0)
    weights: Annotated[tuple[Fraction, ...], Field(min_length=1, max_length=3)] = (1.0,)
    device: Literal["cpu", "gpu"] = "cpu"
    step: Duration | Literal["auto"] = "auto"
    noise: PositiveLength | tuple[PositiveLength, PositiveLength] | None = None
    maybe: Leg | None = None
    named: dict[Annotated[str, Field(pattern=r"^[a-z]+$")], MonteCarlo] = Field(default={})
    odd: Annotated[tuple[Fraction | Literal["all"], ...], AfterValidator(lambda value: value)] | bool = True
    verbose: bool = False
    even: int = 0

    @field_validator("even")
    @classmethod
    def _is_even(cls, value: int) -> int:
        if value % 2:
            raise ValueError("must be even")
        return value


def check(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        validate(Experiment, parse_source(text, "c.yaml"))
    return str(caught.value).split("\n")


LEGS = "; known: straight, turn"
TAGS = "; known: mine:X, straight, turn"
CASES = [
    ("monte_carlo:\n  seeds: 3\n",
     "c.yaml:2: monte_carlo.seeds: not a known setting (did you mean 'seed'?); known: runs, seed"),
    ("zzz: 3\n", "c.yaml:1: zzz: not a known setting; known: name, legs, tagged, filters, monte_carlo, size, "
     "weights, device, step, noise, maybe, named, odd, verbose, even"),
    ("monte_carlo: {runs: 0}", "c.yaml:1: monte_carlo.runs: must be greater than 0, got 0"),
    ("monte_carlo: {runs: 2.5}", "c.yaml:1: monte_carlo.runs: expected a whole number, got 2.5"),
    ("monte_carlo: {runs: '7'}", "c.yaml:1: monte_carlo.runs: expected a whole number, got the text '7'"),
    ("monte_carlo: {runs: true}", "c.yaml:1: monte_carlo.runs: expected a whole number, got true"),
    ("monte_carlo: 3", "c.yaml:1: monte_carlo: expected a group of settings, got 3"),
    ("monte_carlo:\n", "c.yaml:1: monte_carlo: expected a group of settings, got nothing"),
    ("name: 3", "c.yaml:1: name: expected a text, got 3"),
    ("name: A", "c.yaml:1: name: must match '^[a-z]+$', got 'A'"),
    ("verbose: no", "c.yaml:1: verbose: expected true or false, got the text 'no'"),
    ("even: 3", "c.yaml:1: even: must be even"),
    ("legs: 3", "c.yaml:1: legs: expected a list, got 3"),
    ("filters: [1]", "c.yaml:1: filters: expected a group of settings, got a list"),
    ("legs:\n- {kind: straight}\n", "c.yaml:2: legs[0].speed: is required"),
    ("legs:\n- kind: straight\n  speed: 50 kg\n",
     "c.yaml:3: legs[0].speed: '50 kg' is not a speed; give m/s, km/h, or a bare number in m/s"),
    ("legs:\n- kind: straight\n  speed: abc\n",
     "c.yaml:3: legs[0].speed: expected a number, got the text 'abc'; "
     "give m/s, km/h, or a bare number in m/s"),
    ("legs:\n- kind: straight\n  speed: 1\n  duration: -5 ms\n",
     "c.yaml:4: legs[0].duration: must be greater than 0, got '-5 ms'"),
    ("legs:\n- kind: straight\n  speed: .inf\n", "c.yaml:3: legs[0].speed: must be finite, got inf"),
    ("legs:\n- {kind: strait, speed: 1}",
     "c.yaml:2: legs[0].kind: unknown kind 'strait' (did you mean 'straight'?)" + LEGS),
    ("legs:\n- {speed: 1}", "c.yaml:2: legs[0].kind: is required" + LEGS),
    ("legs:\n- 5\n", "c.yaml:2: legs[0]: expected a group of settings, got 5"),
    ("legs:\n- {kind: 5}\n", "c.yaml:2: legs[0].kind: expected one of straight, turn, got 5"),
    ("maybe: {kind: tur}", "c.yaml:1: maybe.kind: unknown kind 'tur' (did you mean 'turn'?)" + LEGS),
    ("maybe: {kind: turn, rates: 1, rate: 2}",
     "c.yaml:1: maybe.rates: not a known setting (did you mean 'rate'?); known: kind, rate, straight"),
    ("tagged: [{kind: tun}]",
     "c.yaml:1: tagged[0].kind: unknown kind 'tun' (did you mean 'turn'?)" + TAGS),
    ("tagged: [{}]", "c.yaml:1: tagged[0].kind: is required" + TAGS),
    ("tagged: [{kind: turn, rate: x y z w}]",
     "c.yaml:1: tagged[0].rate: expected a number, got the text 'x y z w'; "
     "give rad/s, deg/s, or a bare number in rad/s"),
    ("filters:\n  a:\n    kind: vbb\n",
     "c.yaml:3: filters.a.kind: unknown kind 'vbb' (did you mean 'vb_random_matrix'?); "
     "known: feldmann, vb_random_matrix"),
    ("filters:\n  a: {kind: vb_random_matrix,\n   iteration: 3}",
     "c.yaml:3: filters.a.iteration: not a known setting (did you mean 'iterations'?); "
     "known: kind, iterations, forgetting"),
    ("filters:\n  vb_random_matrix:\n    kind: vb_random_matrix\n    iterations: 0",
     "c.yaml:4: filters.vb_random_matrix.iterations: must be at least 1, got 0"),
    ("filters:\n  a:\n    kind: vb_random_matrix\n    iterations: 101",
     "c.yaml:4: filters.a.iterations: must be at most 100, got 101"),
    ("filters: {a: {kind: feldmann, cov: [[1, 2], [2, 1]]}}",
     "c.yaml:1: filters.a.cov: not positive definite: the smallest eigenvalue is -1"),
    ("filters: {a: {kind: feldmann, cov: [[1, 0.2], [0.3, 1]]}}",
     "c.yaml:1: filters.a.cov: not symmetric: entries [1][0] = 0.3 and [0][1] = 0.2 differ"),
    ("filters:\n  a:\n    kind: feldmann\n    cov: [101, 1]\n",
     "c.yaml:2: filters.a: cov is wider than the scene"),
    ("size: [1]", "c.yaml:1: size[1]: is required: the list is too short"),
    ("size: [1, 2, 3]", "c.yaml:1: size: needs at most 2 entries, got 3"),
    ("size:\n- 1\n- -2 m\n", "c.yaml:3: size[1]: must be greater than 0, got '-2 m'"),
    ("weights: []", "c.yaml:1: weights: needs at least 1 entries, got 0"),
    ("weights: [1, 2]", "c.yaml:1: weights[1]: must be at most 1, got 2"),
    ("weights: [0.5 m]", "c.yaml:1: weights[0]: expected a number, got the text '0.5 m'"),
    ("device: gpuu", "c.yaml:1: device: must be 'cpu' or 'gpu', got 'gpuu' (did you mean 'gpu'?)"),
    ("tagged: [{kind: 'mine:X', gains: 1}]",
     "c.yaml:1: tagged[0].gains: not a known setting (did you mean 'gain'?); known: kind, gain"),
    ("named:\n  A b: {runs: 1}\n", "c.yaml:2: named.'A b': the name must match '^[a-z]+$', got 'A b'"),
    ("odd: [0.5, -1]", "c.yaml:1: odd[1]: must be at least 0 or must be 'all', got -1"),
    ("noise: [1, -1]", "c.yaml:1: noise[1]: must be greater than 0, got -1"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "expected"), CASES)
def test_one_mistake_one_line(text, expected):
    assert expected in check(text)


@pytest.mark.parametrize(
    "text", [text for text, _ in CASES if not text.startswith(("noise", "odd", "legs:\n- {kind: 5}"))]
)
def test_one_mistake_is_not_reported_twice(text):
    assert len(check(text)) == 1


def test_alternatives_are_one_problem():
    [message] = check("step: -1")
    assert message == "c.yaml:1: step: must be greater than 0 or must be 'auto', got -1"


def test_keys_that_look_like_kinds_keep_their_place():
    assert check("maybe: {kind: turn, rate: 1, straight: 2}") == [
        "c.yaml:1: maybe.straight: expected true or false, got 2"
    ]
    found = check("maybe:\n  kind: turn\n  rate: x\n  turn: 1\n")
    assert [message.split(" ")[:2] for message in found] == [
        ["c.yaml:3:", "maybe.rate:"],
        ["c.yaml:4:", "maybe.turn:"],
    ]


def test_all_mistakes_at_once_in_order_of_lines():
    text = "size: [0, 1]\nfilters:\n  b: {kind: x}\n  a: {kind: feldmann, q: 1}\n"
    text += "monte_carlo: {runs: 0, sed: 1}\n"
    assert [message.split(" ")[:2] for message in check(text)] == [
        ["c.yaml:1:", "size[0]:"],
        ["c.yaml:3:", "filters.b.kind:"],
        ["c.yaml:4:", "filters.a.q:"],
        ["c.yaml:5:", "monte_carlo.runs:"],
        ["c.yaml:5:", "monte_carlo.sed:"],
    ]


def test_valid_settings_come_back():
    text = "legs: [{kind: straight, speed: 36 km/h}]\nstep: 100 ms\n"
    text += "noise: [1 cm, 2]\nfilters: {a: {kind: feldmann}}"
    experiment = validate(Experiment, parse_source(text, "c.yaml"))
    assert experiment.legs == (Straight(speed=10.0),)
    assert (experiment.step, experiment.noise) == (0.1, (0.01, 2.0))
    assert isinstance(experiment.filters["a"], Feldmann)


def test_problems_print_with_what_they_have():
    problems = [
        Problem(COMMAND_LINE, None, "a.b", "x"),
        Problem("f", None, "", "whole"),
        Problem("f", 10, "b", "later"),
        Problem("f", 2, "", "sooner"),
        Problem("f", 2, "", "sooner"),
    ]
    error = ConfigError(problems)
    assert str(error).split("\n") == ["f:2: sooner", "f:10: b: later", "command line: a.b: x", "f: whole"]
    assert len(error.problems) == 4


def test_control_characters_never_reach_the_terminal():
    for text in ['"a\\e[2Jb": 1', 'name: "\\e[2J\\nx"', 'device: "\\a"', 'filters: {a: {kind: "\\b"}}']:
        [message] = check(text)
        assert message.isprintable()


def test_long_values_are_cut():
    assert all(len(message) < 300 for message in check("device: " + "x" * 5000))


def test_dotted_keys():
    assert dotted(("legs", 0, "steps")) == "legs[0].steps"
    assert dotted(("a.b", "c d", 1, 2)) == "'a.b'.'c d'[1][2]"
    assert dotted(()) == ""


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-3, 3)
    | st.floats()
    | st.sampled_from(["straight", "5 m", "feldmann", "x"]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["kind", "speed", "cov", "turn", "[key]", "runs", "a", "rate"]), inner, max_size=4
        )
    ),
    max_leaves=8,
)


@settings(max_examples=50)
@given(st.dictionaries(st.sampled_from([*Experiment.model_fields, "other"]), VALUES, max_size=4))
def test_any_data_is_valid_or_a_config_error(data):
    source = parse_source("a: 1", "c.yaml")
    source = type(source)(source.path, data, source.places)
    try:
        validate(Experiment, source)
    except ConfigError as error:
        lines = str(error).split("\n")
    else:
        lines = ["c.yaml:1: "]
    assert all(line.startswith("c.yaml:1: ") for line in lines)
    assert not any(word in line for line in lines for word in ("function-", "tuple[", "Input should", "pydantic"))

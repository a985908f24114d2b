"""Settings changed on the command line."""

from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import PositiveInt

from emt.config.errors import COMMAND_LINE, ConfigError, validate
from emt.config.overrides import apply_overrides, parse_key, parse_override
from emt.config.source import Place, parse_source
from emt.settings import Quantity, Settings

TEXT = "monte_carlo:\n  runs: 100\nlegs:\n- {steps: 1}\n- {steps: 2}\nmetrics: [gw]\nempty:\n"


def source():
    return parse_source(TEXT, "c.yaml")


def messages(*overrides: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        apply_overrides(source(), overrides)
    return str(caught.value).split("\n")


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("monte_carlo.runs=1000", ("monte_carlo", "runs"), 1000),
        ("monte_carlo.runs=1e3", ("monte_carlo", "runs"), 1000.0),
        ("monte_carlo.seed=7", ("monte_carlo", "seed"), 7),
        ("metrics=[gw, iou]", ("metrics",), ["gw", "iou"]),
        ("legs.0.steps=5", ("legs", 0, "steps"), 5),
        ("legs[1].steps=5", ("legs", 1, "steps"), 5),
        ("legs[1]={steps: 3}", ("legs", 1), {"steps": 3}),
        ("filters.vb.iterations=3", ("filters", "vb", "iterations"), 3),
        ("empty.a=x=y", ("empty", "a"), "x=y"),
        ("speed=50 km/h", ("speed",), "50 km/h"),
        ("a=null", ("a",), None),
        ("a=''", ("a",), ""),
        ("a='5'", ("a",), "5"),
        ("a='x # y'", ("a",), "x # y"),
        ("a=no", ("a",), "no"),
        (" a = true ", ("a",), True),
        ("a-b_c=1", ("a-b_c",), 1),
    ],
)
def test_an_override_replaces_one_value(override, path, value):
    before = source()
    after = apply_overrides(before, [override])
    found = after.data
    for part in path:
        found = found[part]
    assert found == value
    assert type(found) is type(value)
    assert after.place(path) == Place(COMMAND_LINE, None)
    assert before == source()


def test_places_of_what_was_not_overridden_stay():
    after = apply_overrides(source(), ["monte_carlo.seed=1", "legs.0={steps: 9}"])
    assert after.line(("monte_carlo", "runs")) == 2
    assert after.line(("monte_carlo",)) == 1
    assert after.line(("legs", 1, "steps")) == 5
    assert after.place(("legs", 0, "steps")) == Place(COMMAND_LINE, None)


def test_an_alias_is_changed_in_one_place_only():
    aliased = parse_source("a: &a {x: 1}\nb: *a\n", "c.yaml")
    assert apply_overrides(aliased, ["b.x=2"]).data == {"a": {"x": 1}, "b": {"x": 2}}


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("=", "command line: no key given; expected key=value"),
        ("=3", "command line: no key given; expected key=value"),
        ("runs", "command line: runs: expected key=value"),
        ("", "command line: expected key=value"),
        ("a=", "command line: a: no value given"),
        ("a..b=1", "command line: a..b: malformed key 'a..b'"),
        (".a=1", "command line: .a: malformed key '.a'"),
        ("a.=1", "command line: a.: malformed key 'a.'"),
        ("a[x]=1", "command line: a[x]: malformed key"),
        ("a[-1]=1", "command line: a[-1]: malformed key"),
        ("a b=1", "command line: a b: malformed key"),
        ("[0]=1", "command line: [0]: malformed key"),
        ("a[0]b=1", "command line: a[0]b: malformed key"),
        ("legs.2.steps=1", "command line: legs.2.steps: legs has 2 entries, the last is [1]"),
        ("legs.x=1", "command line: legs.x: legs is a list; give a position such as legs[0]"),
        ("legs.²=1", "command line: legs.²: legs is a list"),
        ("legs.-1=1", "command line: legs.-1: legs is a list"),
        ("monte_carlo[0]=1", "command line: monte_carlo[0]: monte_carlo is not a list"),
        (
            "monte_carlo.runs.x=1",
            "command line: monte_carlo.runs.x: monte_carlo.runs is 100, it has no settings",
        ),
        ("a=[1", "command line: a: not valid YAML: "),
        ("a={b: 1, b: 2}", "command line: a: b: is given twice"),
        ("a=!!python/name:os.system x", "command line: a: the tag !!python/name:os.system is not allowed"),
        ("a=*x", "command line: a: the alias *x has no anchor"),
        ("a=" + "[" * 100, "command line: a: nested deeper than 40 levels"),
        ("a=" + "x" * 30_000, "command line: a: line longer than 20000 characters"),
        ("a=b: c", "command line: a: write lists as [a, b] and groups as {a: 1}"),
        ("a=- b", "command line: a: write lists as [a, b] and groups as {a: 1}"),
        ("a=run #3", "command line: a: the value reads as a comment from '#' on"),
        ("a=#3", "command line: a: the value reads as a comment from '#' on"),
    ],
)
def test_a_malformed_override_is_a_message(override, expected):
    [message] = messages(override)
    assert message.startswith(expected)


def test_all_malformed_overrides_at_once():
    assert len(messages("a", "b=[", "legs.9=1", "monte_carlo.runs=2")) == 3


@pytest.mark.parametrize(
    "pair",
    [("a=1", "a=2"), ("a.b=1", "a={}"), ("legs.0.steps=1", "legs[0].steps=2"), ("metrics.0=1", "metrics=[]")],
)
def test_an_override_never_undoes_an_earlier_one_silently(pair):
    [message] = messages(*pair)
    assert "undoes the earlier override of" in message


def test_a_later_override_may_refine_an_earlier_one():
    assert apply_overrides(source(), ["a={b: 1, c: 2}", "a.b=3"]).data["a"] == {"b": 3, "c": 2}


class Leg(Settings):
    steps: PositiveInt = 1


class MonteCarlo(Settings):
    runs: PositiveInt = 1
    limit: Annotated[float, Quantity("m")] = 1.0


class Experiment(Settings):
    monte_carlo: MonteCarlo
    legs: tuple[Leg, ...]
    metrics: tuple[str, ...]
    empty: None = None


def test_problems_in_overrides_and_in_the_file_are_reported_together():
    changed = apply_overrides(
        parse_source(TEXT.replace("steps: 2", "steps: 0"), "c.yaml"),
        ["monte_carlo.runs=0", "monte_carlos.runs=3", "legs[0]={step: 1}", "monte_carlo.limit=3 kg"],
    )
    with pytest.raises(ConfigError) as caught:
        validate(Experiment, changed)
    lines = str(caught.value).split("\n")
    assert lines[0] == "c.yaml:5: legs[1].steps: must be greater than 0, got 0"
    assert sorted(line.split("; ")[0] for line in lines[1:]) == [
        "command line: legs[0].step: not a known setting (did you mean 'steps'?)",
        "command line: monte_carlo.limit: '3 kg' is not a length",
        "command line: monte_carlo.runs: must be greater than 0, got 0",
        "command line: monte_carlos: not a known setting (did you mean 'monte_carlo'?)",
    ]


def test_parts_are_usable_alone():
    assert parse_key("legs[0].steps") == ("legs", 0, "steps")
    assert parse_key("a[0][1]") == ("a", 0, 1)
    assert parse_override("a.b=[1, x]") == (("a", "b"), [1, "x"])


@given(st.text(max_size=30) | st.text(alphabet="ab.=[]{}0:-#&*! '\"\n", max_size=30))
def test_no_override_raises_anything_but_a_config_error(override):
    try:
        result = apply_overrides(source(), [override])
    except ConfigError as error:
        assert all(line.startswith("command line: ") for line in str(error).split("\n"))  # noqa: PT017
    else:
        assert isinstance(result.data, dict)

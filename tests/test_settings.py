"""Strict settings, units, covariances."""

import json
import math
import subprocess
import sys
import time
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, PositiveInt, TypeAdapter, ValidationError

from emt import settings as s
from emt.matrices import Covariance, Matrix
from emt.settings import Quantity, Settings, field_unit
from emt.units import to_si


class Car(Settings):
    kind: Literal["car"] = "car"
    size: tuple[s.PositiveLength, s.PositiveLength] = (4.5, 2)
    speed: s.Speed = 10
    heading: s.Angle = 0.0
    heading_variance: s.AngleVariance = 0.0
    runs: PositiveInt = 1
    fraction: s.Fraction = 1
    either: s.Length | s.Speed | None = None
    turn: Annotated[float, Quantity("rad/s", gt=0)] = 1.0
    position: s.Vector2 = (0.0, 0.0)
    state: s.Vector4 = (0.0, 0.0, 0.0, 0.0)
    cov: s.Covariance2 = ((1.0, 0.0), (0.0, 1.0))
    shape_cov: s.Covariance3 | None = None
    state_cov: s.Covariance4 | None = None
    legs: tuple[dict[str, s.Duration], ...] = ()
    name: str = "x"


def refusal(annotation: Any, value: Any) -> str:
    with pytest.raises(ValidationError) as caught:
        TypeAdapter(annotation).validate_python(value)
    [error] = caught.value.errors()
    return error["msg"]


def accepted(annotation: Any, value: Any) -> Any:
    return TypeAdapter(annotation).validate_python(value)


@pytest.mark.parametrize(
    ("annotation", "text", "value"),
    [
        (s.Speed, "50 km/h", 50 / 3.6),
        (s.Speed, "50km/h", 50 / 3.6),
        (s.Speed, "-3.6e1 kph", -10),
        (s.Speed, "10 kn", 10 * 1852 / 3600),
        (s.Speed, "1 m s^-1", 1),
        (s.Angle, "-45 deg", -math.pi / 4),
        (s.Angle, "-45°", -math.pi / 4),
        (s.Angle, "1 turn", 2 * math.pi),
        (s.Angle, "3 mrad", 3e-3),
        (s.AngleVariance, "4 deg^2", 4 * math.radians(1) ** 2),
        (s.AngleVariance, "4 deg²", 4 * math.radians(1) ** 2),
        (s.TurnRate, "10 deg/s", math.radians(10)),
        (s.TurnRate, "30 rpm", math.pi),
        (s.LengthVariance, "0.5 m^2", 0.5),
        (s.LengthVariance, "0.5 m**2", 0.5),
        (s.Area, "1 cm*m", 0.01),
        (s.PositiveLength, "25 cm", 0.25),
        (s.PositiveLength, ".5 km", 500),
        (s.PositiveLength, "1 ft", 0.3048),
        (s.Duration, "100 ms", 0.1),
        (s.Duration, "2 min", 120),
        (s.Duration, "1 h", 3600),
        (s.Rate, "10 Hz", 10),
        (s.Density, "3 km^-2", 3e-6),
        (s.Acceleration, "2 m/s/s", 2),
        (s.AccelerationDensity, "2 m^2/s^3", 2),
        (s.SpeedVariance, "4 m^2/s^2", 4),
    ],
)
def test_a_text_with_a_unit_becomes_si(annotation, text, value):
    assert accepted(annotation, text) == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    ("annotation", "text", "message"),
    [
        (s.Speed, "50 kg", "'50 kg' is not a speed; give m/s, km/h, or a bare number in m/s"),
        (s.Speed, "50 km", "'50 km' is not a speed; give m/s, km/h, or a bare number in m/s"),
        (s.Angle, "5 percent", "'5 percent' is not an angle; give rad, deg, or a bare number in rad"),
        (s.Angle, "5 m/m", "'5 m/m' is not an angle; give rad, deg, or a bare number in rad"),
        (s.Angle, "5 deg^2", "'5 deg^2' is not an angle; give rad, deg, or a bare number in rad"),
        (s.TurnRate, "5 Hz", "'5 Hz' is not a turn rate; give rad/s, deg/s, or a bare number in rad/s"),
        (s.Length, "5 M", "'5 M' is not a length; give m, km, or a bare number in m"),
        (
            Annotated[float, Quantity("rad/s^2")],
            "1 m",
            "'1 m' is not a quantity in rad/s^2; give rad/s^2, or a bare",
        ),
        (s.Length, "5", "expected a number, got the text '5'; give m, km, or a bare number in m"),
        (s.Length, "abc", "expected a number, got the text 'abc'; give"),
        (s.Length, "", "expected a number, got the text ''; give"),
        (s.Length, "1+1 m", "expected a number"),
        (s.Length, "(1) m", "expected a number"),
        (s.Length, "1 (m)", "expected a number"),
        (s.Length, "2**9999999 m", "expected a number"),
        (s.Length, "1 m^99", "expected a number"),
        (s.Length, "1 m**9**9", "expected a number"),
        (s.Length, "1 m\x00", "expected a number"),
        (s.Length, "١ m", "expected a number"),
        (s.Length, "1_0 m", "expected a number"),
        (s.Length, "nan m", "expected a number"),
        (s.Length, "1 " + "m" * 60, "expected a number"),
        (s.Length, "1e999 m", "Input should be a finite number"),
        (s.PositiveLength, "-1 km", "Input should be greater than 0"),
        (s.PositiveLength, "0 m", "Input should be greater than 0"),
        (s.Fraction, "0.5 m", "Input should be a valid number"),
        (s.PositiveFloat, "5", "Input should be a valid number"),
    ],
)
def test_a_text_that_is_no_such_quantity_is_refused(annotation, text, message):
    assert refusal(annotation, text).startswith(message)


@given(st.text(max_size=45) | st.from_regex(r"[0-9]{1,3} ?[a-zA-Zµ°]{1,6}([/*^ ][a-z1-9]{1,4}){0,4}", fullmatch=True))
def test_no_text_raises_anything_but_a_value_error(text):
    for unit in ("m/s", "rad^2"):
        try:
            value = to_si(text, unit)
        except ValueError:
            continue
        assert isinstance(value, float)


def test_long_texts_are_refused_at_once():
    start = time.process_time()
    assert refusal(s.Length, "1" * 5_000_000 + " m").startswith("expected a number")
    assert refusal(s.Length, "1 " + "m " * 2_000_000).startswith("expected a number")
    assert time.process_time() - start < 1.0


@pytest.mark.parametrize("value", [True, None, [1.0], math.nan, math.inf, -math.inf, {}, b"1", 1j, "1"])
@pytest.mark.parametrize(
    "annotation",
    [s.Length, s.Speed, s.Angle, s.Duration, s.PositiveFloat, s.Fraction, s.UnitInterval, s.AngleVariance],
)
def test_quantities_take_finite_numbers_only(annotation, value):
    assert refusal(annotation, value)


@pytest.mark.parametrize(
    ("annotation", "good", "bad"),
    [
        (s.PositiveLength, 1, 0),
        (s.NonNegativeLength, 0, -1e-300),
        (s.Area, 1, 0),
        (s.Duration, 1e-300, 0),
        (s.Rate, 1, 0),
        (s.Density, 0, -1),
        (s.LengthVariance, 0, -1),
        (s.SpeedVariance, 0, -1),
        (s.AngleVariance, 0, -1),
        (s.AccelerationDensity, 0, -1),
        (s.PositiveFloat, 1, 0),
        (s.NonNegativeFloat, 0, -1),
        (s.Fraction, 0, -1e-9),
        (s.Fraction, 1, 1.0000001),
        (s.UnitInterval, 1, 0),
        (s.UnitInterval, 1e-9, 1.0000001),
    ],
)
def test_bounds(annotation, good, bad):
    value = accepted(annotation, good)
    assert (value, type(value)) == (good, float)
    assert refusal(annotation, bad)


@pytest.mark.parametrize(
    "data",
    [
        {"sped": 1}, {"runs": 1.0}, {"runs": "1"}, {"runs": True}, {"runs": 0}, {"name": 1}, {"fraction": "1"},
        {"fraction": True}, {"speed": math.nan}, {"size": [1]}, {"size": [1, 2, 3]}, {"size": "12"}, {"kind": "bus"},
    ],
)  # fmt: skip
def test_settings_are_strict(data):
    with pytest.raises(ValidationError):
        Car.model_validate(data)


def test_lists_become_tuples_and_ints_floats():
    car = Car.model_validate(
        {"size": [4, "200 cm"], "legs": [{"a": 1}], "cov": [[2, 1], [1, 2]], "position": [1, "1 km"]}
    )
    assert (car.size, car.legs, car.cov, car.position) == (
        (4.0, 2.0), ({"a": 1.0},), ((2.0, 1.0), (1.0, 2.0)), (1.0, 1000.0)
    )  # fmt: skip
    assert all(type(x) is float for x in (*car.size, car.speed, *car.cov[0]))


def test_settings_are_frozen_hashable_and_survive_a_round_trip():
    class Small(Settings):
        size: tuple[s.Length, ...] = (1.0,)
        cov: s.Covariance2 = ((1.0, 0.0), (0.0, 1.0))

    small = Small.model_validate({"size": [1, 2]})
    with pytest.raises(ValidationError):
        small.size = (3.0,)  # type: ignore[misc]
    assert hash(small) == hash(Small(size=(1.0, 2.0)))
    assert Small.model_validate(json.loads(small.model_dump_json())) == small
    assert Small.model_validate_json(small.model_dump_json()) == small


def test_defaults_are_validated():
    class Wrong(Settings):
        length: s.PositiveLength = -1.0

    with pytest.raises(ValidationError):
        Wrong()


@pytest.mark.parametrize(
    "annotation", [list[float], list, set[int], tuple[list[int], ...], dict[str, list[int]] | None]
)
def test_list_fields_are_a_programming_error(annotation):
    with pytest.raises(TypeError, match=r"declare tuple\[...\]"):
        type("Wrong", (Settings,), {"__annotations__": {"x": annotation}})


SAME = ((4.0, 1.0), (1.0, 2.0))


@pytest.mark.parametrize(
    ("value", "matrix"),
    [
        ([[4, 1], [1, 2]], SAME),
        (((4.0, 1.0), (1.0, 2.0)), SAME),
        ([["4 m^2", "10000 cm^2"], [1, 2]], SAME),
        ([4, "2 m^2"], ((4.0, 0.0), (0.0, 2.0))),
        ({"diagonal": [4, 2]}, ((4.0, 0.0), (0.0, 2.0))),
        ([1e-300, 1e300], ((1e-300, 0.0), (0.0, 1e300))),
        ([[1, 1 + 1e-13], [1, 2]], ((1.0, 1 + 1e-13), (1.0, 2.0))),
        ([[1e-12, 0.999], [0.999, 1e12]], ((1e-12, 0.999), (0.999, 1e12))),
    ],
)
def test_covariances_are_kept_as_given(value, matrix):
    assert accepted(s.Covariance2, value) == matrix


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([[1, 0.2], [0.3, 1]], "not symmetric: entries [1][0] = 0.3 and [0][1] = 0.2 differ"),
        ([[1, 1 + 1e-11], [1, 2]], "not symmetric: entries [1][0] = 1.0 and [0][1] = 1.00000000001 differ"),
        ([[1, 2], [2, 1]], "not positive definite: the smallest eigenvalue is -1"),
        ([[1, 1], [1, 1]], "not positive definite: the smallest eigenvalue is 0"),
        ([[1, 1e200], [1e200, 1]], "not positive definite: the smallest eigenvalue is -1e+200"),
        ([[1e-320, 1e300], [1e300, 1]], "not positive definite: the smallest eigenvalue is -1e+300"),
        ([1, 0], "variance [1][1] must be greater than 0, got 0.0"),
        ([[1, 0], [0, -1]], "variance [1][1] must be greater than 0, got -1.0"),
        ([1, 2, 3], "variances: expected 2 numbers, got 3"),
        ([], "variances: expected 2 numbers, got 0"),
        ([[1, 0]], "expected 2 rows of 2 numbers, got 1 rows"),
        ([[1, 0], [0]], "row [1]: expected 2 numbers, got 1"),
        ([[1, 0], 1], "row [1]: expected a list of 2 numbers, got 1"),
        (
            [[1, True], ["a", 1]],
            "row [0]: entry [1]: expected a number, got true; row [1]: entry [0]: expected a number",
        ),
        ([[1, math.nan], [math.nan, 1]], "row [0]: entry [1]: must be finite, got nan; row [1]"),
        ([["1 m", 0], [0, 1]], "row [0]: entry [0]: '1 m' is not an area"),
        (["1 deg^2", 1], "variances: entry [0]: '1 deg^2' is not an area"),
        (3, "expected 2 rows of 2 numbers or 2 variances, got 3"),
        ("x", "expected 2 rows of 2 numbers or 2 variances, got the text 'x'"),
        (None, "expected 2 rows of 2 numbers or 2 variances, got nothing"),
        ({"diag": [1, 1]}, "expected 2 rows of 2 numbers or only the key 'diagonal'"),
        ({"diagonal": [[1, 0], [0, 1]]}, "diagonal: expected 2 numbers, got rows"),
    ],
)
def test_what_is_no_covariance(value, message):
    assert refusal(s.Covariance2, value).startswith(message)


def test_semidefinite_accepts_singular_but_not_indefinite():
    noise = Annotated[Matrix, Covariance(2, "m", semidefinite=True)]
    for value in ([[1, 1], [1, 1]], [0, 0], [[0, 0], [0, 1]], [[0.25, 0.5], [0.5, 1.0]]):
        assert accepted(noise, value)
    assert refusal(noise, [[1, 2], [2, 1]]) == "not positive semidefinite: the smallest eigenvalue is -1"
    assert refusal(noise, [[0, 1e-9], [1e-9, 1]]) == "variance [0][0] is 0, so entry [0][1] must be 0, got 1e-09"
    assert refusal(noise, [-1, 1]) == "variance [0][0] must be at least 0, got -1.0"


def test_mixed_units_of_a_state():
    cov = accepted(s.Covariance4, [1, "1 m^2", "4 m^2/s^2", "12.96 km^2/h^2"])
    assert np.allclose(np.diag(cov), [1, 1, 4, 1])
    rows = np.eye(3).tolist()
    rows[0][0] = "1 deg^2"
    rows[0][1] = rows[1][0] = "1 cm*mrad"
    assert accepted(s.Covariance3, rows)[0][:2] == pytest.approx((math.radians(1) ** 2, 1e-5))
    assert refusal(s.Covariance4, [1, 1, "1 m^2", 1]).startswith(
        "variances: entry [2]: '1 m^2' is not a speed variance"
    )


@given(st.integers(1, 4), st.integers(0, 2**32 - 1), st.floats(1e-6, 1e6))
def test_every_gram_matrix_is_a_covariance_and_its_negative_is_not(n, seed, scale):
    factor = np.random.default_rng(seed).normal(size=(n, n)) + 3 * np.eye(n)
    matrix = scale * (factor @ factor.T + np.eye(n))
    matrix = (matrix + matrix.T) / 2
    annotation = s.covariance(n, "m")
    assert accepted(annotation, matrix.tolist()) == tuple(map(tuple, matrix.tolist()))
    matrix[-1, -1] -= 1.01 / np.linalg.inv(matrix)[-1, -1]
    assert refusal(annotation, matrix.tolist())


def test_vectors():
    assert accepted(s.Vector4, [1, "1 km", "36 km/h", 0]) == (1.0, 1000.0, pytest.approx(10.0), 0.0)
    assert refusal(s.Vector2, [1]) == "expected 2 numbers, got 1"
    assert refusal(s.Vector2, 1) == "expected a list of 2 numbers, got 1"
    assert refusal(s.Vector2, [1, math.inf]) == "entry [1]: must be finite, got inf"
    assert accepted(s.vector(3, "1"), [1, 2, 3]) == (1.0, 2.0, 3.0)
    assert refusal(s.vector(1, "1"), ["1 m"]) == "entry [0]: expected a number, got the text '1 m'"
    with pytest.raises(ValueError, match="3 entries need 3 units, got 2"):
        s.vector(3, ("m", "m"))


@pytest.mark.parametrize(
    ("field", "unit"),
    [
        ("size", "m"), ("speed", "m/s"), ("heading", "rad"), ("heading_variance", "rad^2"), ("turn", "rad/s"),
        ("position", "m"), ("state", "m, m/s"), ("cov", "m^2"), ("shape_cov", "rad^2, m^2"),
        ("state_cov", "m^2, m^2/s^2"), ("legs", "s"), ("either", "m, m/s"), ("fraction", None), ("runs", None),
        ("name", None),
    ],
)  # fmt: skip
def test_units_of_fields(field, unit):
    assert field_unit(Car, field) == unit


def test_json_schema_carries_units_and_allows_texts():
    schema = Car.model_json_schema()
    fields = schema["properties"]
    assert schema["additionalProperties"] is False
    assert fields["speed"]["unit"] == "m/s"
    assert {option["type"] for option in fields["speed"]["anyOf"]} == {"number", "string"}
    assert fields["size"]["prefixItems"][0]["unit"] == "m"
    assert fields["size"]["prefixItems"][0]["anyOf"][0]["exclusiveMinimum"] == 0
    assert fields["fraction"] == {
        "default": 1,
        "maximum": 1,
        "minimum": 0,
        "title": "Fraction",
        "type": "number",
    }
    assert fields["cov"]["unit"] == "m^2"
    assert fields["state"]["unit"] == "m, m/s"


def test_a_description_of_a_field_reaches_the_schema_beside_its_unit():
    class Described(Settings):
        length: s.Length = Field(default=1.0, description="Full length.")

    entry = Described.model_json_schema()["properties"]["length"]
    assert (entry["description"], entry["unit"]) == ("Full length.", "m")


def test_pint_is_imported_only_for_texts():
    program = (
        "import sys, emt.settings as s, pydantic\n"
        "speed = pydantic.TypeAdapter(s.Speed)\n"
        "speed.validate_python(1.0); assert 'pint' not in sys.modules\n"
        "speed.validate_python('1 km/h'); assert 'pint' in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)

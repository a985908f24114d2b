"""Mean and covariance of a named state in settings: units by name, sizes checked."""

from typing import Any

from emt.matrices import Covariance, Matrix, Vector
from emt.types import POSITION, VELOCITY
from emt.units import refusal


def state_units(names: tuple[str, ...]) -> tuple[str, ...]:
    """SI unit of each entry of a state, by its name."""
    known = dict.fromkeys(POSITION, "m") | dict.fromkeys(VELOCITY, "m/s")
    return tuple(known.get(name, "1") for name in names)


def belief_in_units(given: Any, states: tuple[str, ...]) -> Any:
    """Mean and covariance of a state as SI numbers, where they fit the state; what does not is left to be refused."""
    if not isinstance(given, dict):
        return given
    units, n, faults, new = state_units(states), len(states), [], dict(given)
    for key, kind in (("mean", Vector(n, units)), ("cov", Covariance(n, units, semidefinite=True))):
        if new.get(key) is not None:
            try:
                new[key] = kind.check(new[key])
            except ValueError as error:
                faults.append(f"{key}: {error}")
    if faults:
        raise refusal("; ".join(faults))
    return new


def belief_faults(key: str, mean: tuple[float, ...], cov: Matrix | None, states: tuple[str, ...]) -> list[str]:
    """What is wrong with the sizes of mean and covariance of a state."""
    n, names = len(states), ", ".join(states)
    faults = [] if len(mean) == n else [f"{key}.mean: expected {n} numbers ({names}), got {len(mean)}"]
    if cov is not None and len(cov) != n:
        faults.append(f"{key}.cov: expected {n} rows ({names}), got {len(cov)}")
    return faults

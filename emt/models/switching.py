"""Markov chains over a few names, as settings."""

from pydantic import model_validator

from emt.registry import UnknownName, suggest
from emt.settings import Fraction, Settings

ROUNDING = 1e-9


class SwitchingSettings(Settings):
    """A Markov chain: how probable it is to stay, all changes being equally probable; or the changes there are, by
    name, staying having the rest of the probability; or the whole matrix."""

    stay: Fraction | None = None
    changes: dict[str, dict[str, Fraction]] | None = None
    """From a name to others: their probabilities."""
    transition: tuple[tuple[Fraction, ...], ...] | None = None
    """Row i: probabilities of going from i to each."""

    @model_validator(mode="after")
    def _one_of_three(self):
        if sum(given is not None for given in (self.stay, self.changes, self.transition)) != 1:
            raise ValueError("give one of stay, changes or transition")
        return self

    def faults(self, names: tuple[str, ...]) -> list[str]:
        """What is wrong with the chain for these names."""
        faults = [] if self.transition is None else transition_faults(self.transition, names)
        for origin, goals in (self.changes or {}).items():
            for name in dict.fromkeys((origin, *goals)):
                if name not in names:
                    faults.append(f"changes: {UnknownName(name, names, suggest(name, names), 'name')}")
            if origin in goals:
                faults.append(f"changes: '{origin}' to itself: staying has what the changes leave")
            if sum(goals.values()) > 1.0 + ROUNDING:
                faults.append(f"changes: those from '{origin}' sum to {sum(goals.values()):.6g}, more than 1")
        return faults

    def matrix(self, names: tuple[str, ...]) -> tuple[tuple[float, ...], ...]:
        """The transition matrix over these names."""
        n = len(names)
        if self.transition is not None:
            return self.transition
        if self.changes is not None:
            rows = []
            for origin in names:
                goals = self.changes.get(origin, {})
                rest = max(1.0 - sum(goals.values()), 0.0)
                rows.append(tuple(rest if name == origin else goals.get(name, 0.0) for name in names))
            return tuple(rows)
        stay = 1.0 if n == 1 or self.stay is None else self.stay
        other = (1.0 - stay) / max(n - 1, 1)
        return tuple(tuple(stay if i == j else other for j in range(n)) for i in range(n))


def transition_faults(rows: tuple[tuple[float, ...], ...], names: tuple[str, ...]) -> list[str]:
    """What is wrong with a transition matrix whose rows should sum to 1."""
    n = len(names)
    if len(rows) != n or any(len(row) != n for row in rows):
        return [f"transition: expected {n} rows of {n} probabilities, one per {', '.join(names)}"]
    faults = [
        f"transition: row {i} (from '{name}') sums to {sum(row):.6g}, not 1"
        for i, (name, row) in enumerate(zip(names, rows, strict=True))
        if abs(sum(row) - 1.0) > ROUNDING
    ]
    if faults and all(abs(sum(column) - 1.0) <= ROUNDING for column in zip(*rows, strict=True)):
        faults = ["transition: its columns sum to 1, its rows do not; give the transpose (row: from, column: to)"]
    return faults


def unreachable(
    rows: tuple[tuple[float, ...], ...], start: tuple[float, ...], names: tuple[str, ...]
) -> tuple[str, ...]:
    """Names that the chain can neither start in nor come to."""
    seen = {k for k, p in enumerate(start) if p > 0.0}
    fresh = set(seen)
    while fresh:
        fresh = {j for i in fresh for j, p in enumerate(rows[i]) if p > 0.0} - seen
        seen |= fresh
    return tuple(name for k, name in enumerate(names) if k not in seen)

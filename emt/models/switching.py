"""Markov chains over a few names, as settings."""

from pydantic import model_validator

from emt.settings import Fraction, Settings

ROUNDING = 1e-9


class SwitchingSettings(Settings):
    """A Markov chain: either how probable it is to stay, all changes being equally probable, or the whole matrix."""

    stay: Fraction | None = None
    transition: tuple[tuple[Fraction, ...], ...] | None = None
    """Row i: probabilities of going from i to each."""

    @model_validator(mode="after")
    def _one_of_two(self):
        if (self.stay is None) == (self.transition is None):
            raise ValueError("give either stay or transition")
        return self

    def faults(self, names: tuple[str, ...]) -> list[str]:
        """What is wrong with the chain for these names."""
        return [] if self.transition is None else transition_faults(self.transition, names)

    def matrix(self, n: int) -> tuple[tuple[float, ...], ...]:
        """The transition matrix over n names."""
        if self.transition is not None:
            return self.transition
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

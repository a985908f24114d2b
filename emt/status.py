"""Status bits: failure as data. Free of JAX, so that results can be read anywhere."""

from enum import IntFlag


class Status(IntFlag):
    """What happened in a step, or-ed over the steps of a run. The values are stable."""

    NON_FINITE = 1
    NOT_POSITIVE_DEFINITE = 2
    DIVERGED = 4
    MEASUREMENT_SKIPPED = 8
    GROSS_INNOVATION = 16
    FLOOR_USED = 32
    SCAN_OVERFLOW = 64
    MOMENTS_PROJECTED = 128
    LOST = 256
    """Lost by the experiment's rule, but kept in the averages."""

    @classmethod
    def names_of(cls, bits: int) -> list[str]:
        """Names of the set bits, for people: `['non-finite', 'floor used']`."""
        return [
            str(flag.name).lower().replace("_", " ").replace("non finite", "non-finite") for flag in cls if bits & flag
        ]


FAILURE = Status.NON_FINITE | Status.NOT_POSITIVE_DEFINITE | Status.DIVERGED
"""Bits that take a run out of the averages; the others only inform."""

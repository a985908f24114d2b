"""Imports every scenario of this package, which registers it under its kind."""

from emt.scenarios import (
    annotated,
    connected,
    constant_velocity,
    coordinated_turns,
    course,
    recorded,
    state_space,
    stationary,
    trajectory,
)

__all__ = [
    "annotated",
    "connected",
    "constant_velocity",
    "coordinated_turns",
    "course",
    "recorded",
    "state_space",
    "stationary",
    "trajectory",
]

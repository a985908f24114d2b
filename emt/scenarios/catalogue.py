"""Imports every scenario of this package, which registers it under its kind."""

from emt.scenarios import constant_velocity, coordinated_turns, course, recorded, stationary, trajectory

__all__ = ["constant_velocity", "coordinated_turns", "course", "recorded", "stationary", "trajectory"]

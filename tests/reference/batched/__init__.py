"""The filters of the benchmark in plain NumPy, all runs at once.

Components come first and runs last, (component, run): every row is contiguous over the runs, so that one call of NumPy
does one operation of the textbook for all of them. Two-by-two matrices are in closed form.
"""

from tests.reference.batched import kinematics, mem_ekf_star, moment_ukf, multiple_model, particle, shape_mixture, vb

__all__ = ["kinematics", "mem_ekf_star", "moment_ukf", "multiple_model", "particle", "shape_mixture", "vb"]

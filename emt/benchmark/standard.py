"""The standard workloads by name. It loads no JAX, which counts the processors when it is loaded."""

from typing import NamedTuple


class Workload(NamedTuple):
    """A standard workload, `benchmark/NAME` among the shipped experiments; a chunk of its runs is timed."""

    number: str
    few: int
    """Runs given to what takes one run after the other."""
    many: int
    """Runs given at once to batched NumPy: as many as it is fastest with, more than emt needs."""


WORKLOADS = {
    "vb": Workload("W1", 4, 1664),
    "mem_ekf_star": Workload("W2", 4, 1664),
    "moment_ukf": Workload("W3", 2, 1664),
    "shape_mixture": Workload("W4", 2, 832),
    "multiple_model": Workload("W5", 4, 832),
    "particle": Workload("W6", 8, 26),
}

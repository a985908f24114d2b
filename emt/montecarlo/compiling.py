"""Options of XLA for the programs of an experiment."""

from typing import Any

import jax

from emt.device import cpu_facts, widest_vectors

OWN_SUMS: dict[str, Any] = {"xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT"}
"""Options of XLA on CPUs for every program: its library computes products of matrices, not sums. Those of the library
are slower for few numbers, and their rounding depends on the number of threads."""
COMPILATION: dict[str, Any] = OWN_SUMS | {"xla_cpu_use_fusion_emitters": False}
"""Options for filters: these compile twice as fast, and run as fast wherever `linalg.once` keeps the compiler from
computing the same thing again and again. The simulator, compiled once, runs faster without."""
WIDE: dict[str, Any] = {"xla_cpu_prefer_vector_width": 512}
"""Added for filters on processors with vectors of 512 bits, of which XLA uses 256 by default: on EPYC of Zen 4 class
most filters take 3 to 10 % less time, simulators no less. Sums along short axes are rounded otherwise."""
QUICK_COMPILATION: dict[str, Any] = COMPILATION | {"xla_backend_optimization_level": 0}
"""Options for programs that run once on few runs: compiling takes longer than running. Results differ in rounding."""


def filter_options(*, quick: bool = False) -> dict[str, Any] | None:
    """For filters and what is computed around them; none where there is no CPU.

    Args:
        quick: compile in a hurry, for a few runs.
    """
    if jax.default_backend() != "cpu":
        return None
    wide = WIDE if widest_vectors(cpu_facts()) == "avx512f" else {}
    return QUICK_COMPILATION if quick else COMPILATION | wide


def simulator_options(*, quick: bool = False) -> dict[str, Any] | None:
    """For simulators, likewise."""
    return (QUICK_COMPILATION if quick else OWN_SUMS) if jax.default_backend() == "cpu" else None

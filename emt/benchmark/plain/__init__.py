"""The filters of the benchmarks as one writes them in JAX from the equations, which emt's own are measured against.

Small matrices and `jnp.linalg`, a loop over iterations and over all slots of a scan with a mask, `jax.lax.scan` over
time, `jax.vmap` over runs and `jax.jit` around it: nothing is arranged for speed, and nothing is made slow.
"""

from emt.benchmark.plain import mem_ekf_star, moment_ukf, multiple_model, particle, shape_mixture, vb
from emt.benchmark.plain.base import Form, Prepared

__all__ = ["FORMS", "Form", "Prepared"]

FORMS: dict[str, Form] = {
    "vb": vb.prepare,
    "mem_ekf_star": mem_ekf_star.prepare,
    "moment_ukf": moment_ukf.prepare,
    "multiple_model": multiple_model.prepare,
    "particle": particle.prepare,
    "shape_mixture": shape_mixture.prepare,
}
"""By name of the workload: `vb` for the experiment `benchmark/vb`."""

"""What emt costs: standard workloads, measured beside other ways to compute the same.

`workloads` holds the parts of a workload that are timed, `rivals` everything they are compared with (`peers` other
packages, `plain` the textbook in JAX, and the NumPy references of a checkout); `measure` puts both on the clock.
`processes`, `scaling` and `reproducing` measure whole processes. `report` shows it all, `goals` judges it.
"""

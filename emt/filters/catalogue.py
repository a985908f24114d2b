"""Imports every filter of this package, which registers it under its kind."""

from emt.filters import (
    feldmann,
    gp_ett,
    imm,
    kalman,
    lan_li,
    mem_ekf_star,
    moment_ukf,
    multiple_model,
    particle,
    sampled_posterior,
    shape_mixture,
    ukf,
    variable_structure,
    vb_random_matrix,
)

__all__ = [
    "feldmann",
    "gp_ett",
    "imm",
    "kalman",
    "lan_li",
    "mem_ekf_star",
    "moment_ukf",
    "multiple_model",
    "particle",
    "sampled_posterior",
    "shape_mixture",
    "ukf",
    "variable_structure",
    "vb_random_matrix",
]

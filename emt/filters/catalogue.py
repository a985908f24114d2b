"""Imports every filter of this package, which registers it under its kind."""

from emt.filters import (
    feldmann,
    gp_ett,
    imm,
    lan_li,
    mem_ekf_star,
    moment_ukf,
    sampled_posterior,
    shape_mixture,
    vb_random_matrix,
)

__all__ = [
    "feldmann",
    "gp_ett",
    "imm",
    "lan_li",
    "mem_ekf_star",
    "moment_ukf",
    "sampled_posterior",
    "shape_mixture",
    "vb_random_matrix",
]

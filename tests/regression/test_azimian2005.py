"""Azimian 2005: Monte Carlo at full size against another implementation, and against theory."""

from functools import cache

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from emt.config.load import at_smoke_scale, load_experiment
from emt.reports.paper import published_of
from emt.reports.published import compare
from emt.reports.summary import summarise
from emt.runner import run
from emt.store import read_folder

PUBLISHED = published_of("azimian2005")
CHECKED = {
    "linear": ["kf", "predictor"],
    "growth": ["ekf", "upf"],
    "range_bearing": ["ukf", "upf"],
    "maneuver": ["imm"],
    "thirteen_ds1": ["imm", "lms", "mgs"],
}
"""Filters that are run again; the report has all of them."""


@cache
def summary(name: str, folder, runs: int = 120, seed: int = 20051):
    """Summary of an experiment with other random numbers than those of the report."""
    kept = ", ".join(CHECKED[name])
    scale = [f"monte_carlo.smoke_runs={runs}", f"monte_carlo.smoke_filters=[{kept}]", f"monte_carlo.seed={seed}"]
    run(at_smoke_scale(load_experiment(f"azimian2005/{name}", scale)), folder / name, figures=False)
    return summarise(read_folder(folder / name))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("azimian2005")


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKED)
def test_agrees_with_another_implementation(name, folder):
    """Every number within 4 combined standard errors, on other runs than those of the report."""
    assert PUBLISHED is not None
    found, seen = summary(name, folder), set()
    for table in PUBLISHED.tables:
        if table.experiment == f"azimian2005/{name}" and table.origin == "independent":
            compared = [one for one in compare(table, found) if one.cell.filter in CHECKED[name]]
            seen |= {one.cell.filter for one in compared}
            assert {one.verdict for one in compared} <= {"agrees", "close"}, compared
    assert seen >= set(CHECKED[name]) - {"predictor"}


@pytest.mark.slow
def test_linear_experiment_is_that_of_theory(folder):
    """Errors within 1 % of the algebraic Riccati equation's, by SciPy."""
    found = summary("linear", folder)["filters"]["kf"]
    F, H = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2)), np.eye(2, 4)
    Q, R = 0.1 * np.kron([[1.0 / 3.0, 0.5], [0.5, 1.0]], np.eye(2)), 100.0 * np.eye(2)
    P = solve_discrete_are(F.T, H.T, Q, R)
    P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
    for name, variance in (("position_rmse", P[0, 0] + P[1, 1]), ("velocity_rmse", P[2, 2] + P[3, 3])):
        error = found[name]["se"]
        assert abs(found[name]["value"] - np.sqrt(variance)) < 0.01 * np.sqrt(variance) + 3.0 * error

"""Zea, Faion and Hanebeck 2014 against an independent implementation of the same settings."""

from functools import cache

import numpy as np
import pytest

from emt.config.load import load_experiment
from emt.montecarlo.chunks import Engine
from emt.montecarlo.program import Program

RUNS = 50
METRICS = ("alpha_a_error", "alpha_b_error", "alpha_c_folded_error", "length_a_error", "length_b_error")

# medians over 100 runs of the means over scans after 1000, and tolerances
INDEPENDENT = {
    ("a", "weighted"): ((0.0763, 0.0846, 0.240, 0.0312, 0.0356), (0.03, 0.03, 0.04, 0.08, 0.08)),
    ("b", "weighted"): ((0.0237, 0.0258, 0.0684, 0.0078, 0.0121), (0.04, 0.04, 0.05, 0.15, 0.15)),
    ("a", "known_component"): ((0.0637, 0.0733, 0.198), (0.04, 0.04, 0.04)),
    ("b", "known_component"): ((0.0219, 0.0242, 0.066), (0.05, 0.05, 0.05)),
}


@cache
def medians(scenario: str, label: str) -> np.ndarray:
    """Medians over runs of the metrics of one filter."""
    kind = "" if label == "weighted" else ", association: known"
    loaded = load_experiment(
        f"zea2014/scenario_{scenario}",
        [
            f"filters={{{label}: {{kind: shape_mixture, samples: {{count: 32}}{kind}}}}}",
            f"metrics=[{', '.join(METRICS)}]",
        ],
    )
    engine = Engine(Program.of(loaded.experiment), loaded.experiment.monte_carlo.seed, RUNS)
    engine.compile()
    return np.median(engine.run_chunk(0, RUNS)[f"{label}/values"], axis=0)


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "label"), INDEPENDENT)
def test_agrees_with_an_independent_implementation(scenario, label):
    """Within tolerances stated for 100 runs, a little wider for half as many."""
    numbers, tolerances = INDEPENDENT[scenario, label]
    found = medians(scenario, label)[: len(numbers)]
    np.testing.assert_array_less(np.abs(found / numbers - 1.0), 1.25 * np.array(tolerances))

"""What the results of an experiment depend on, recordings included."""

import hashlib
from typing import Any

import jax
import numpy as np

from emt.config.load import Loaded
from emt.montecarlo.program import Program


def identity_of(loaded: Loaded, program: Program) -> dict[str, Any]:
    """Plain data that is equal if and only if the results are; a recording takes part by its content."""
    identity = loaded.identity()
    if hasattr(loaded.experiment.scenario, "path"):
        digest = hashlib.sha256()
        for leaf in jax.tree.leaves(program.world.scenario):
            digest.update(np.asarray(leaf).tobytes())
        identity["recording_sha256"] = digest.hexdigest()
    return identity

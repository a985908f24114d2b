"""One, two and eight devices give the same bits."""

import os
import subprocess
import sys

from tests.montecarlo.small import TEXT, write

SCRIPT = """
import sys
import jax
import numpy as np
from emt.config.load import load_experiment
from emt.device import configure
from emt.montecarlo.chunks import Engine
from emt.montecarlo.program import Program

configure()
loaded = load_experiment(sys.argv[1])
program, ranges = Program.of(loaded.experiment), [(0, 16), (16, 32), (32, 48), (48, 53)]

def chunks(devices):
    engine = Engine(program, 3, 16, quick=True, devices=devices)
    engine.compile()
    assert engine.at_once == len(devices)
    return list(engine.run_chunks(ranges))

assert len(jax.devices()) == 8
alone = chunks(jax.devices()[:1])
assert [(start, stop) for start, stop, _ in alone] == ranges
for n in (2, 8):
    for (start, stop, arrays), (*found, others) in zip(alone, chunks(jax.devices()[:n]), strict=True):
        assert [start, stop] == found
        assert arrays.keys() == others.keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(others[name], array, err_msg=f"{name}, {n} devices")
print("same bits in", len(alone), "chunks of", len(alone[0][2]), "arrays")
"""


def test_the_number_of_devices_changes_no_bit(tmp_path):
    """Of results, tracks and scans, for a filter in closed form and one that goes through the points."""
    cov = "{diagonal: [0.05, 1, 0.3]}"
    mem = f"  mem: {{kind: mem_ekf_star, shape_cov: {cov}, shape_noise: {cov}}}\n"
    path = write(tmp_path, TEXT.replace("metrics:", mem + "metrics:"))
    flags = "--xla_force_host_platform_device_count=8"
    found = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(path)],
        env=os.environ | {"XLA_FLAGS": flags},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    assert "same bits in 4 chunks" in found.stdout

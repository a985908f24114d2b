"""What XLA is told about the processor."""

import pytest

from emt import device
from emt.montecarlo.compiling import filter_options, simulator_options

WIDTH = "xla_cpu_prefer_vector_width"


@pytest.mark.parametrize(("flags", "width"), [("fpu avx2 avx512f", 512), ("fpu avx avx2", None)])
def test_filters_use_vectors_as_wide_as_there_are(monkeypatch, tmp_path, flags, width):
    monkeypatch.setattr(device, "CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setattr("jax.default_backend", lambda: "cpu")
    device.CPUINFO.write_text(f"processor\t: 0\nflags\t\t: {flags}\n\n")
    filters, *others = filter_options(), filter_options(quick=True), simulator_options()
    assert filters is not None
    assert filters.get(WIDTH) == width
    assert all(options and WIDTH not in options for options in others)

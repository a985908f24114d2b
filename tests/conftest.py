"""Settings of all tests: double precision, strict JAX, checked array types, repeatable random examples."""

import os
from pathlib import Path

import hypothesis
import jax
import pytest
from beartype import beartype
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


def check_functions(fn):
    """Checks array shapes and dtypes at every call of a function or method.

    Construction of dataclasses is left alone: those of parameters are pytrees, which hold plain numbers
    before they are cast to arrays, and which JAX also builds with placeholder leaves.
    """
    return fn if fn.__name__ == "__init__" else beartype(fn)


install_import_hook(
    ["emt.filters", "emt.scenarios", "emt.metrics", "emt.shapes"],
    f"{check_functions.__module__}.check_functions",
)

hypothesis.settings.register_profile(
    "emt",
    deadline=None,
    max_examples=25,
    derandomize=True,
    database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("emt")


QUICK = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)
"""The everyday tests compile for longer than they run: with these flags of XLA they take two thirds of the time."""


def pytest_configure(config: pytest.Config) -> None:
    """Compiled programs are kept between test runs and shared; a damaged entry is compiled anew."""
    if config.option.markexpr == "not slow":
        os.environ["XLA_FLAGS"] = f"{QUICK} {os.environ.get('XLA_FLAGS', '')}".strip()
    if getattr(config, "cache", None) is not None:
        jax.config.update("jax_compilation_cache_dir", str(config.cache.mkdir("jax")))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


LONGEST = (
    "tuning/test_search",
    "test_documents",
    "cli/test_",
    "filters/test_shape",
    "montecarlo/",
    "regression/",
    "filters/",
)
"""Files that take longest, first: whoever is done early takes the short ones."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Orders files by how long they take."""

    def place(item: pytest.Item) -> int:
        return next((k for k, part in enumerate(LONGEST) if part in item.nodeid), len(LONGEST))

    items.sort(key=place)


@pytest.fixture(scope="session")
def golden() -> Path:
    """Folder of the vectors made with the authors' own codes."""
    folder = Path(__file__).parents[2] / "shared" / "golden"
    if not folder.is_dir():
        pytest.skip("the golden vectors are not part of this checkout")
    return folder

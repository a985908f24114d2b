"""Other ways to compute the filter of a workload, on the same scans: each is checked before it is timed."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from emt.benchmark.peers import PEERS, installed
from emt.benchmark.peers.agreement import error_difference, largest_difference
from emt.benchmark.peers.base import ELLIPSE, Scans
from emt.benchmark.standard import WORKLOADS
from emt.benchmark.workloads import Bench
from emt.config.load import load_experiment
from emt.config.shipped import SHIPPED
from emt.montecarlo.chunks import Engine
from emt.montecarlo.program import Program

LARGEST_DIFFERENCE = 1e-8
"""Of reports that are the same but for rounding, relative to the largest value in their column."""
STANDARD_ERRORS = 4.0
"""Between position errors of filters that draw their own random numbers."""
BATCHED, PER_RUN, PLAIN = "batched NumPy", "per-run NumPy", "plain vmap"
NEEDS_CHECKOUT = "not measured: needs a checkout of the project"
NEEDS_PEERS = "not installed: pip install 'emt[peers]'"
VARIANTS = {
    "moment_ukf": (
        [f"filters.ukf_imm.modes.{mode}.augmented=true" for mode in ("cv", "ct")],
        "plain vmap takes sigma points from a Cholesky factor at every point, as printed, which is another filter: it "
        "is checked against emt's form of that, augmented: true",
    )
}
"""Settings of emt's filter that make it what the plain form computes, where the workload's do not; and a remark."""


class DisagreementError(Exception):
    """A rival computes something else; the text says by how much."""


class Rival(NamedTuple):
    """Another way to compute the filter."""

    name: str
    version: str
    """Package and version."""
    runs: int
    """The first of the workload, on which it is checked and timed; it may take all of them more than once."""
    exact: bool
    """Whether it computes the same but for rounding."""
    columns: tuple[str, ...] | None
    """Of its reports; None for all that the workload has."""
    call: Callable[[], Any]
    """Computes the reports (run, step, k), or an array that becomes them."""
    own: np.ndarray | None = None
    """What emt reports in its first runs, where it computes a variant of the workload's filter."""
    remark: str = ""
    """Which."""


class Missing(NamedTuple):
    """A rival that cannot be measured."""

    name: str
    reason: str


class Agreement(NamedTuple):
    """How far the reports of a rival are from emt's."""

    difference: float
    """The largest, relative to its column; of filters with random numbers, that of position errors (m)."""
    standard_error: float | None = None
    """Of the latter (m)."""

    def text(self) -> str:
        """For a table."""
        if self.standard_error is None:
            return f"{self.difference:.0e}"
        return f"{self.difference:+.2g} ± {self.standard_error:.2g} m"


def agreement(rival: Rival, bench: Bench) -> Agreement:
    """Checks the reports of a rival.

    Raises:
        DisagreementError: they are not those of emt.
    """
    found = np.asarray(rival.call(), dtype=float)
    own = bench.reports(rival.columns)[: rival.runs] if rival.own is None else rival.own
    found = found[: len(own)]
    if found.shape != own.shape:
        raise DisagreementError(f"{bench.name}: {rival.name} reports {found.shape}, emt {own.shape}")
    if rival.exact:
        is_ellipse = found.shape[-1] == len(ELLIPSE)
        difference = largest_difference(same_ellipses(found, own) if is_ellipse else found, own)
        if not difference <= LARGEST_DIFFERENCE:  # NaN differs
            message = f"the largest relative difference is {difference:.1e}, more than {LARGEST_DIFFERENCE:.0e}"
            raise DisagreementError(f"{bench.name}: {rival.name} does not report what emt does: {message}")
        return Agreement(difference)
    gap, error = error_difference(found, own, bench.arrays["truth/state"][: len(own)])
    if not abs(gap) <= STANDARD_ERRORS * error:
        message = f"position errors differ by {gap:.3g} m, with a standard error of {error:.3g} m"
        raise DisagreementError(f"{bench.name}: {rival.name} does not report what emt does: {message}")
    return Agreement(gap, error)


def same_ellipses(found: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Reports of ellipses with orientations within a quarter turn of emt's: half a turn changes no ellipse, and two
    filters that round differently may report either."""
    turns = np.round((found[..., -1] - own[..., -1]) / np.pi)
    return np.concatenate([found[..., :-1], found[..., -1:] - np.pi * turns[..., None]], axis=-1)


def rivals_of(bench: Bench, *, peers: bool) -> tuple[list[Rival], list[Missing]]:
    """What there is to compare a workload with, and what is missing.

    Args:
        peers: whether other packages take part.
    """
    found = [*numpy_references(bench), plain_form(bench), *(other_packages(bench) if peers else ())]
    return [one for one in found if isinstance(one, Rival)], [one for one in found if isinstance(one, Missing)]


def first(scans: Scans, runs: int) -> Scans:
    """Scans of the first runs; of more than there are, all of them again and again."""
    chosen = np.arange(runs) % len(scans.points)
    means = None if scans.prior_means is None else scans.prior_means[chosen]
    return Scans(scans.points[chosen], scans.mask[chosen], means)


@contextmanager
def importable(root: Path) -> Iterator[None]:
    """The packages of a folder come first for a while."""
    sys.path.insert(0, str(root))
    try:
        yield
    finally:
        sys.path.remove(str(root))


def numpy_references(bench: Bench) -> list[Rival | Missing]:
    """The same equations in NumPy: all runs at once, and one run after the other. They are among the tests."""
    if not (SHIPPED / "tests" / "reference" / "workloads.py").is_file():
        return [Missing(name, NEEDS_CHECKOUT) for name in (BATCHED, PER_RUN)]
    with importable(SHIPPED):
        module = import_module("tests.reference.workloads")
    reference, experiment, name = module.REFERENCES[bench.name], bench.loaded.experiment, f"numpy {version('numpy')}"

    def rival(title: str, form: Callable, runs: int) -> Rival:
        given = module.Scans(*first(bench.scans, runs))
        return Rival(title, name, runs, reference.exact, None, lambda: form(experiment, given))

    many = WORKLOADS[bench.name].many
    return [rival(BATCHED, reference.batched, many), rival(PER_RUN, reference.per_run, bench.few)]


def plain_form(bench: Bench) -> Rival | Missing:
    """The textbook in JAX under `vmap` and `jit`, on all runs."""
    from emt.benchmark.plain import FORMS

    function, arguments = FORMS[bench.name](bench.loaded.experiment, bench.scans)
    compiled = function.lower(*arguments).compile()
    exact, own, remark = bench.name != "particle", None, ""
    if bench.name in VARIANTS:
        overrides, remark = VARIANTS[bench.name]
        own = variant_reports(bench, overrides)

    def call() -> jax.Array:
        return jax.block_until_ready(compiled(*arguments))

    return Rival(PLAIN, f"jax {version('jax')}", bench.runs, exact, None, call, own, remark)


def variant_reports(bench: Bench, overrides: Sequence[str]) -> np.ndarray:
    """What emt reports in the first runs of a workload under other settings of its filter."""
    experiment = load_experiment(str(bench.loaded.source.path), overrides).experiment
    experiment = bench.loaded.experiment.model_copy(update={"filters": experiment.filters})
    program = Program.of(experiment)
    engine = Engine(program, experiment.monte_carlo.seed, bench.few, quick=True)
    engine.compile()
    variant = bench._replace(program=program, arrays=engine.run_chunk(0, bench.few, tracked=bench.few))
    return variant.reports()


def other_packages(bench: Bench) -> list[Rival | Missing]:
    """Filters of installed packages, and the packages that are not."""
    found: list[Rival | Missing] = []
    for peer in PEERS:
        if peer.workload != bench.name:
            continue
        release = installed(peer)
        title = f"{peer.package} {peer.name}"
        if release is None:
            found.append(Missing(title, NEEDS_PEERS))
            continue
        call = peer.prepare(bench.loaded.experiment, first(bench.scans, bench.few))
        found.append(Rival(title, f"{peer.package} {release}", bench.few, peer.exact, peer.report, call))
    return found

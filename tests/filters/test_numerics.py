"""What every filter promises about its arithmetic: batches, compilation, gradients, precision, long runs."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

import emt.filters.catalogue  # noqa: F401 - registers the filters
from emt.linalg import Sym2
from emt.status import FAILURE
from emt.types import Ellipse, Measurements, Prior
from tests.filters.cases import (
    CASES,
    FAST_COMPILE,
    MAIN,
    N_RUNS,
    Case,
    Problem,
    Report,
    assert_same,
    batch_tracker,
    cast,
    differences,
    pick,
    problems,
    random_problem,
    report,
    solved,
    stack,
    track,
    tracker,
)

every = pytest.mark.parametrize("case", CASES, ids=str)
main = pytest.mark.parametrize("case", MAIN, ids=str)


ROUNDING = {"vb_random_matrix": 1e-12, "mem_ekf_star": 1e-12, "feldmann": 1e-12, "gp_ett": 1e-8}
"""Relative difference of two programs for the same thing; `gp_ett` inverts an ill-conditioned matrix."""


@main
def test_batch_equals_one_by_one_and_padding_does_not_matter(case):
    """Runs do not see each other; up to rounding, as sums over more slots may be taken in another order."""
    given = problems(case)
    pad = ((0, 0), (0, 0), (0, 3))
    points = jnp.pad(given.scans.points, (*pad, (0, 0)), constant_values=jnp.nan)
    wider = given._replace(scans=Measurements(points, jnp.pad(given.scans.mask, pad), given.scans.overflow))
    batch, one_by_one = report(solved(case)[0]), tracker(case)
    for run in range(0, N_RUNS, 3):
        alone = report(one_by_one(pick(wider, run))[0])
        assert_same(case, alone, Report(*(field[run] for field in batch)), ROUNDING[case.label])


@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=pytest.mark.slow) if c.label == "gp_ett" else c for c in MAIN], ids=str
)
def test_compiled_equals_eager(case):
    """Operation by operation; slow where there are many different ones."""
    given = pick(problems(case), 5)
    n = 2
    first = given._replace(scans=pick(given.scans, slice(n)), dt=given.dt[:n])
    with jax.disable_jit():
        eager = report(track(case, first)[0])
    compiled = Report(*(field[5, :n] for field in report(solved(case)[0])))
    assert_same(case, compiled, eager, ROUNDING[case.label])


def loss(estimate, info):
    """A smooth number that every part of the answer enters."""
    shape = jnp.concatenate([leaf.reshape(-1) for leaf in jax.tree.leaves(estimate.shape)])
    if isinstance(estimate.shape, Ellipse):
        extent = jax.vmap(lambda e: Sym2.ellipse(e.semi_axes[0], e.semi_axes[1], e.orientation).array())(estimate.shape)
        shape = extent.reshape(-1)
    weights = jnp.cos(jnp.arange(shape.size, dtype=shape.dtype))
    return (
        jnp.sin(estimate.mean).sum()
        + jnp.log(jnp.trace(estimate.cov, axis1=1, axis2=2)).sum()
        + (weights * jnp.tanh(0.1 * shape)).sum()
        + 1e-2 * info.nis.sum()
        + 1e-2 * info.log_likelihood.sum()
    )


def inexact(tree):
    """The leaves one can differentiate by."""
    return [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]


def with_inexact(tree, leaves):
    given = iter(leaves)
    return jax.tree.map(lambda leaf: next(given) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf, tree)


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=[pytest.mark.slow] * (case.label != "vb_random_matrix")) for case in MAIN],
    ids=str,
)
def test_gradients_are_finite_and_equal_finite_differences(case):
    """By every number of parameters, model, prior and scans; NaN in the padding, an empty scan on the way."""
    given = pick(problems(case), 2)
    clean = inexact(given)
    dirty = given._replace(
        scans=given.scans._replace(points=jnp.where(given.scans.mask[..., None], given.scans.points, jnp.nan))
    )
    gradient = jax.jit(
        jax.jacfwd(lambda leaves: loss(*track(case, with_inexact(dirty, leaves)))),
        compiler_options=FAST_COMPILE,
    )(inexact(dirty))
    assert all(np.isfinite(np.asarray(g)).all() for g in gradient)

    rng, step = np.random.default_rng(3), 1e-6
    directions = [
        [jnp.asarray(rng.normal(size=leaf.shape)) * (0.05 + jnp.abs(leaf)) for leaf in clean]
        for _ in range(N_RUNS // 2)
    ]
    moved = [
        with_inexact(given, [leaf + sign * step * d for leaf, d in zip(clean, direction, strict=True)])
        for direction in directions
        for sign in (1.0, -1.0)
    ]
    values = np.asarray(jax.vmap(loss)(*batch_tracker(case)(stack(moved))))
    expected = (values[0::2] - values[1::2]) / (2.0 * step)
    actual = [sum(float((g * d).sum()) for g, d in zip(gradient, direction, strict=True)) for direction in directions]
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


@main
def test_single_precision_is_near_double_precision(case):
    """Nothing is promoted on the way, and nothing is lost but digits.

    Not in every run of `gp_ett`: its linearisation may fail, and then the last digit decides where it goes.
    """
    estimate, info = batch_tracker(case)(cast(problems(case), np.float32))
    assert {leaf.dtype for leaf in jax.tree.leaves(estimate)} == {jnp.dtype(np.float32)}
    assert not (np.asarray(info.status) & int(FAILURE)).any()
    ours, theirs = report(estimate), report(solved(case)[0])
    found = [
        max(differences(case, *(Report(*(part[run] for part in side)) for side in (ours, theirs))).values())
        for run in range(N_RUNS)
    ]
    tolerance, runs = SINGLE[case.label]
    assert (np.array(found) < tolerance).sum() >= runs, found


SINGLE = {
    "vb_random_matrix": (1e-5, N_RUNS),
    "mem_ekf_star": (1e-5, N_RUNS),
    "feldmann": (1e-5, N_RUNS),
    "gp_ett": (0.3, N_RUNS - 2),
}
"""Largest relative change, and how many runs keep to it."""


@cache
def long_track(case: Case):
    """Jitted run of 10,000 steps over the scans of a problem, again and again about a moving object."""

    def run(problem: Problem):
        flt, key = case.build(problem.params, problem.model), jax.random.key(0)
        dt = jnp.asarray(1.0)

        def step(state, k):
            scan = jax.tree.map(lambda leaf: leaf[k % leaf.shape[0]], problem.scans)
            angle = 0.02 * k.astype(float)
            centre = 30.0 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
            scan = scan._replace(points=scan.points + centre[None, :])
            state, info = flt.update(flt.predict(state, dt, key), scan, key)
            estimate = flt.estimate(state)
            shape = estimate.shape
            smallest = shape.semi_axes.min() if isinstance(shape, Ellipse) else shape.radii.max()
            return state, (estimate.mean, estimate.cov, smallest, info.status)

        return jax.lax.scan(step, flt.init(problem.prior, key), jnp.arange(10_000))[1]

    return jax.jit(run, compiler_options=FAST_COMPILE)


@main
def test_step_ten_thousand_is_as_sound_as_the_first(case):
    """Covariances exactly symmetric and definite, semi-axes positive, no guard at work, no track loss."""
    given = pick(problems(case), 7)
    rng = np.random.default_rng(8)
    around, n = rng.uniform(0.0, 2.0 * np.pi, (12, 9)), rng.integers(0, 10, 12)
    radius = 1.0 if case.source == "outline" else np.sqrt(rng.uniform(size=(12, 9)))
    points = np.stack([6.0 * radius * np.cos(around), 2.5 * radius * np.sin(around)], -1)
    mask = np.arange(9) < n[:, None]
    scans = Measurements(jnp.asarray(points), jnp.asarray(mask), given.scans.overflow)
    prior = Prior(jnp.array([30.0, 0.0, 0.0, 0.6]), given.prior.cov, Ellipse(jnp.array([6.0, 3.0]), jnp.asarray(0.1)))
    mean, cov, smallest, status = map(np.asarray, long_track(case)(given._replace(scans=scans, prior=prior)))
    assert np.isfinite(mean).all()
    assert np.isfinite(cov).all()
    assert np.abs(cov - np.swapaxes(cov, 1, 2)).max() == 0.0
    assert np.linalg.eigvalsh(cov).min() > 0.0
    assert smallest.min() > 0.0
    assert not (status & int(FAILURE)).any()
    steps = np.arange(10_000)
    centre = 30.0 * np.stack([np.cos(0.02 * steps), np.sin(0.02 * steps)], 1)
    assert np.abs(mean[-1000:, :2] - centre[-1000:]).max() < 6.0


@pytest.mark.parametrize("case", [case for case in CASES if case.known_shape is not None], ids=str)
def test_consistent_on_its_own_model(case):
    """With the shape known, NEES of (x, y, vx, vy) has mean 4 within the chi-square band of 99.99 %."""
    runs, n_steps, capacity = 320, 12, 9
    params = case.params(case.known_shape)
    rng = np.random.default_rng(11)
    base = random_problem(case, 0)
    # mean field of VB leaves the sensor noise out of the position covariance: keep it small
    noise = 0.01 * np.eye(2)
    model = cast(type(base.model)(base.model.noise, Sym2.of(noise), 0.25), np.float64)
    dt = np.asarray(base.dt)
    axes, angle, psd = np.array([6.0, 3.0]), 0.4, float(base.model.noise.psd)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    spread = 0.25 * turn @ np.diag(axes**2) @ turn.T + noise
    prior = base.prior._replace(ellipse=Ellipse(jnp.asarray(axes), jnp.asarray(angle)))
    state = np.asarray(prior.mean) + rng.normal(size=(runs, 4)) @ np.linalg.cholesky(np.asarray(prior.cov)).T
    truth, points = [], []
    for t in dt:
        F = np.kron([[1.0, t], [0.0, 1.0]], np.eye(2))
        Q = psd * np.kron([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]], np.eye(2))
        state = state @ F.T + rng.normal(size=(runs, 4)) @ np.linalg.cholesky(Q).T
        truth.append(state)
        points.append(state[:, None, :2] + rng.normal(size=(runs, capacity, 2)) @ np.linalg.cholesky(spread).T)
    mask = np.arange(capacity) < rng.integers(0, capacity + 1, (runs, n_steps, 1))
    scans = cast(Measurements(np.stack(points, 1), mask, np.zeros((runs, n_steps), bool)), np.float64)
    shared = Problem(params, model, prior, None, jnp.asarray(dt))
    found = []
    for start in range(0, runs, N_RUNS):
        chunk = stack([shared._replace(scans=pick(scans, run)) for run in range(start, start + N_RUNS)])
        found.append(report(batch_tracker(case)(chunk)[0]))
    mean, cov = np.concatenate([f.mean for f in found]), np.concatenate([f.cov for f in found])
    error = mean - np.stack(truth, 1)
    nees = np.einsum("rki,rki->rk", error, np.linalg.solve(cov, error[..., None])[..., 0])
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 4 * runs) / runs
    for step in (0, 5, n_steps - 1):
        assert low < nees[:, step].mean() < high, (step, low, nees[:, step].mean(), high)

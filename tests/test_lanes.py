"""Mapping by a trailing axis, loops with one bound, and values computed once change no result."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emt.filters.moment_ukf import MomentUkfSettings
from emt.filters.unscented import Gaussian, merge_gaussians, product, square_root
from emt.lanes import each, lanes_last, total
from emt.linalg import once
from emt.scans import as_scan, filled_slots, is_seen, of_each_run, prepared, scan_statistics, screen
from tests.filters.cases import FAST_COMPILE
from tests.filters.test_moments_and_modes import CT, CV, built, prior

RNG = np.random.default_rng(5)
RUNS, N = 6, 4


def covariances() -> jnp.ndarray:
    factors = RNG.normal(size=(RUNS, N, N))
    return jnp.asarray(factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(N))


def merged(weights, belief: Gaussian):
    """Square root of a mixture of a belief and its mirror image."""
    means, covs = jnp.stack([belief.mean, -belief.mean]), jnp.stack([product(belief.root)] * 2)
    mean, cov = merge_gaussians(weights, means, covs)
    return Gaussian(mean, square_root(cov))


def test_runs_on_the_last_axis_give_what_runs_on_the_first_give():
    beliefs = Gaussian(jnp.asarray(RNG.normal(size=(RUNS, N))), jax.vmap(square_root)(covariances()))
    weights = jnp.asarray(RNG.dirichlet(np.ones(2), size=RUNS))
    plain, last = jax.vmap(merged)(weights, beliefs), jax.vmap(lanes_last(merged))(weights, beliefs)
    for ours, theirs in zip(jax.tree.leaves(last), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-13)


def test_arguments_that_runs_share_are_shared():
    beliefs = Gaussian(jnp.asarray(RNG.normal(size=(RUNS, N))), jax.vmap(square_root)(covariances()))
    even = jnp.asarray([0.25, 0.75])
    shared = jax.vmap(lanes_last(merged), in_axes=(None, 0))(even, beliefs)
    plain = jax.vmap(merged, in_axes=(None, 0))(even, beliefs)
    np.testing.assert_allclose(shared.root, plain.root, rtol=1e-12, atol=1e-13)
    one = lanes_last(merged)(even, jax.tree.map(lambda leaf: leaf[2], beliefs))
    np.testing.assert_allclose(one.mean, plain.mean[2], rtol=1e-12)


def shifted(cov, shift):
    return product(square_root(cov)) + shift[:, None] * shift[None, :], total(shift)


def test_maps_within_maps():
    """Modes within runs within experiments."""
    covs = jnp.stack([jnp.stack([covariances() for _ in range(3)]) for _ in range(2)])
    shifts = jnp.asarray(RNG.normal(size=(2, 3, RUNS, N)))

    def nested(function):
        return jax.jit(jax.vmap(jax.vmap(function)))(covs, shifts)

    plain = nested(jax.vmap(shifted))
    for function in (each(lanes_last(shifted)), jax.vmap(lanes_last(shifted))):
        for ours, theirs in zip(nested(function), plain, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-13)


def test_forward_derivatives_pass_through():
    """As `emt tune` takes them, of one run and of many."""
    cov = covariances()
    direct = jax.vmap(lambda c: jax.jvp(square_root, (c,), (jnp.eye(N),))[1])(cov)
    mapped = jax.jvp(jax.vmap(lanes_last(square_root)), (cov,), (jnp.broadcast_to(jnp.eye(N), cov.shape),))[1]
    np.testing.assert_allclose(mapped, direct, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("runs", [False, True])
def test_jacobians_where_only_tangents_are_mapped(runs):
    """Through a loop whose carry depends on what is differentiated, beside an argument that does not."""
    start, other = covariances(), jnp.asarray(RNG.normal(size=(N, N)))

    def step(cov, matrix):
        return 0.1 * (cov.swapaxes(0, 1) * matrix + cov)

    def jacobian(function):
        def end(x):
            def one(cov):
                return jax.lax.scan(lambda c, _: (function(c * x[0] + x[1], other), None), cov, None, length=3)[0]

            return jax.vmap(one)(start) if runs else one(start[0])

        return jax.jit(jax.jacfwd(end))(jnp.asarray([1.0, 2.0, 3.0]))

    np.testing.assert_allclose(jacobian(lanes_last(step)), jacobian(step), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("modes", [False, True])
def test_forward_derivatives_along_many_directions_at_once(modes):
    """As `emt tune` takes them with several parameters, of runs and of modes within runs."""
    last = lanes_last(square_root)
    inner = each(last) if modes else last
    cov = jnp.stack([covariances() for _ in range(3)], axis=1) if modes else covariances()
    plain = jax.vmap(square_root) if modes else square_root
    moves = jnp.asarray(RNG.normal(size=(2, *cov.shape)))
    moves = moves + moves.swapaxes(-1, -2)

    def along(function):
        return jax.jit(jax.vmap(lambda move: jax.jvp(jax.vmap(function), (cov,), (move,))[1]))(moves)

    np.testing.assert_allclose(along(inner), along(plain), rtol=1e-10, atol=1e-12)


def test_the_sum_is_the_sum():
    values = jnp.asarray(RNG.normal(size=(5, 3)))
    np.testing.assert_allclose(total(values), values.sum(axis=0), rtol=1e-14)
    np.testing.assert_array_equal(total(values[:1]), values[0])


@pytest.mark.bits
def test_once_changes_nothing():
    values = {"a": jnp.asarray(RNG.normal(size=7)), "b": (jnp.asarray(2.0),)}
    through = jax.jit(once)(values, jnp.asarray(0.25))
    for ours, theirs in zip(jax.tree.leaves(through), jax.tree.leaves(values), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def scans(counts: list[int]):
    """Scans with so many points, each with one hole."""
    made = [as_scan(jnp.asarray(RNG.normal(size=(n, 2))), 9) for n in counts]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *made)


def test_a_batch_loops_to_its_fullest_scan():
    batch = scans([0, 3, 7, 1])
    assert jax.vmap(filled_slots)(batch).tolist() == [7, 7, 7, 7]
    assert [int(filled_slots(jax.tree.map(lambda leaf, k=k: leaf[k], batch))) for k in range(4)] == [0, 3, 7, 1]


@pytest.mark.parametrize("settings", [CV, CT])
def test_company_changes_no_image_moments(settings):
    """A run beside fuller scans goes through more slots, and comes to the same."""
    flt, key = built(MomentUkfSettings.model_validate(settings | {"augmented": False})), jax.random.key(0)

    def one(scan):
        return flt.update(flt.predict(flt.init(prior(), key), jnp.asarray(1.0), key), scan, key)

    batch = scans([2, 8, 0, 5])
    together = jax.jit(jax.vmap(one), compiler_options=FAST_COMPILE)(batch)
    for k in range(4):
        alone = jax.jit(one, compiler_options=FAST_COMPILE)(jax.tree.map(lambda leaf, k=k: leaf[k], batch))
        for ours, theirs in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(ours[k], theirs, rtol=1e-11, atol=1e-12)


def test_a_scan_is_prepared_once():
    """Statistics and the screening travel with it, and are not computed again."""
    points = jnp.asarray([[1.0, 2.0], [jnp.nan, 0.0], [3.0, -2.0]])
    given = as_scan(points, 4)
    clean = prepared(given)
    assert bool(clean.skipped)
    assert screen(clean) is clean
    assert scan_statistics(clean) is clean.statistics
    assert float(clean.statistics.count) == 2.0
    np.testing.assert_array_equal(clean.statistics.mean.array(), [2.0, 0.0])
    assert bool(is_seen(clean))
    assert not bool(is_seen(prepared(as_scan(jnp.zeros((0, 2)), 2))))


def test_what_each_run_has_of_its_own_is_what_all_share():
    shared, own = {"mean": jnp.arange(3.0), "count": jnp.asarray(2)}, jnp.arange(float(RUNS))
    assert jax.tree.all(jax.tree.map(np.array_equal, of_each_run(shared, own[0]), shared))
    found = jax.vmap(lambda mine: of_each_run((shared, mine), mine), out_axes=0)(own)
    for run in range(RUNS):
        alone = jax.tree.map(lambda leaf, run=run: leaf[run], found)
        assert jax.tree.all(jax.tree.map(np.array_equal, alone, (shared, own[run])))


def test_a_loop_whose_start_is_each_runs_own_is_mapped_in_one_pass():
    """JAX traces the body of a mapped loop once more for every pass in which it finds something to map."""
    traced = []

    @jax.custom_batching.custom_vmap
    def seen(x):
        return x

    @seen.def_vmap
    def _(axis_size, in_batched, x):
        traced.append(in_batched)
        return x, in_batched[0]

    def passes(start_of) -> int:
        def loop(own):
            return jax.lax.scan(lambda carry, _: (seen(carry + own), None), start_of(own), length=3)[0]

        traced.clear()
        np.testing.assert_allclose(jax.vmap(loop)(jnp.arange(4.0)), 3.0 * jnp.arange(4.0))
        return len(traced)

    assert passes(lambda own: jnp.zeros(())) == 2
    assert passes(lambda own: of_each_run(jnp.zeros(()), own)) == 1

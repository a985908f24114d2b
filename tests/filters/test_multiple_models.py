"""Multiple-model filters of points, with fixed and variable sets, against plain NumPy and each other."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emt.config.load import load_experiment
from emt.config.state_space_model import StateSpaceModelSettings
from emt.models.state_space.model import StateSpaceModel, state_space_model
from emt.models.state_space.motions import ConstantTurn, grouped, in_order
from emt.status import FAILURE
from tests.filters.point_cases import (
    TIGHT,
    Answer,
    World,
    assert_close,
    kinematic,
    maneuver,
    maneuver_world,
    some_cannot_be,
    tracked,
    world_of,
)
from tests.reference import kalman, multiple_model, variable_structure

THIRTEEN = "azimian2005/thirteen_ds1"


@cache
def thirteen_world(seed: int = 0) -> World:
    """A short flight in the style of the scenario: still, corner, outer, still, axis, and the opposite corner."""
    rng = np.random.default_rng(seed)
    pushes = np.repeat([[0, 0], [18, 22], [2, 37], [0, 0], [25, 2], [-19, -21]], [5, 8, 6, 6, 6, 6], axis=0)
    state, way = np.array([8000.0, 8000.0, 600.0, 600.0]), []
    for push in pushes:
        state = kinematic(1.0) @ state + np.concatenate([0.5 * push, push])
        way.append(state[:2])
    values = np.array(way) + np.sqrt(1250.0) * rng.normal(size=(len(way), 2))
    return world_of(maneuver(THIRTEEN), [8020.0, 7990.0, 590.0, 605.0], np.diag([1250.0, 1250.0, 100.0, 100.0]), values)


def full_world(seed: int = 0) -> World:
    """The maneuver without its empty scan."""
    world = maneuver_world(maneuver(), 24, seed)
    values = np.array(world.scans.points)[:, 0]
    values[12] = 0.5 * (values[11] + values[13])
    return world_of(world.model, world.prior.mean, world.prior.cov, values)


WORLDS = {"thirteen": thirteen_world, "maneuver": full_world}


def textbook_models(model: StateSpaceModel) -> multiple_model.Models:
    """(F, b, Q) of every motion for steps of a second, written anew."""
    G = np.kron([[0.5], [1.0]], np.eye(2))
    models = []
    for motion in model.motions:
        F, b = kinematic(1.0), np.zeros(4)
        if isinstance(motion, ConstantTurn):
            w = float(motion.rate)
            s, c = np.sin(w), np.cos(w)
            F[:2, 2:] = [[s / w, -(1.0 - c) / w], [(1.0 - c) / w, s / w]]
            F[2:, 2:] = [[c, -s], [s, c]]
        else:
            b = G @ np.asarray(motion.acceleration)
        models.append((F, b, float(motion.noise.variance) * G @ G.T))
    return models


def fixed(world: World) -> dict:
    """What the steps of the oracles share."""
    R, pi = np.asarray(world.model.measurement.cov), np.asarray(world.model.transition)
    return {"models": textbook_models(world.model), "H": np.eye(2, 4), "R": R, "pi": pi}


def start(world: World) -> multiple_model.State:
    """All models with the same prior."""
    n = len(world.model.motions)
    x, P = np.asarray(world.prior.mean), np.asarray(world.prior.cov)
    return multiple_model.State(np.stack([x] * n), np.stack([P] * n), multiple_model.log(np.asarray(world.model.start)))


def values(world: World) -> list[np.ndarray]:
    return list(np.asarray(world.scans.points)[:, 0])


def probabilities(answer: Answer) -> np.ndarray:
    """(step, model), in the order of the model."""
    return np.stack([answer.estimate.modes[name] for name in answer.estimate.modes], axis=1)


def in_model_order(answer: Answer, world: World) -> np.ndarray:
    """(step, model); compiled programs sort the names of modes."""
    return np.stack([answer.estimate.modes[name] for name in world.model.names], axis=1)


def assert_step(answer: Answer, world: World, k: int, mean, cov, mu) -> None:
    """Overall mean, covariance and probabilities of a step."""
    assert_close(answer.estimate.mean[k], mean, what=f"mean at {k}")
    assert_close(answer.estimate.cov[k], cov, what=f"cov at {k}")
    np.testing.assert_array_equal(answer.estimate.cov[k], answer.estimate.cov[k].T)
    np.testing.assert_allclose(in_model_order(answer, world)[k], mu, rtol=0, atol=TIGHT)


def evidence(x, P, log_predicted, z, shared: dict) -> float:
    """Log-likelihood of a scan under the mixture of all models, each from its own mean and covariance."""
    known = zip(x, P, shared["models"], strict=True)
    each = [multiple_model.filtered(*start, z, model, shared["H"], shared["R"])[2] for *start, model in known]
    return multiple_model.log_sum_exp(log_predicted + np.array(each))


def bank(method: str, **more) -> dict:
    return {"kind": "multiple_model", "method": method, **more}


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("method", ["static", "static, floor", "gpb1", "imm", "gpb2"])
def test_fixed_sets_are_those_of_the_textbook(name, method):
    world = WORLDS[name]()
    shared, state = fixed(world), start(world)
    floor = 1e-3 if "floor" in method else 0.0
    answer = tracked(bank(method.split(",")[0], floor=floor), world)
    x, P, log_mu = state.x[0], state.P[0], state.log_mu
    unchained = {key: value for key, value in shared.items() if key != "pi"}
    for k, z in enumerate(values(world)):
        match method:
            case "static" | "static, floor":
                mu = np.maximum(np.exp(state.log_mu), floor)
                expected = evidence(state.x, state.P, multiple_model.log(mu / mu.sum()), z, shared)
                assert_close(answer.info.log_likelihood[k], expected)
                state, mean, cov = multiple_model.static_step(state, z, floor=floor, **unchained)
            case "gpb1":
                x, P, log_mu = multiple_model.gpb1_step(x, P, log_mu, z, **shared)
                state, mean, cov = state._replace(log_mu=log_mu), x, P
            case "imm":
                W = multiple_model.mixing_weights(state.log_mu, shared["pi"])
                mixtures = [multiple_model.merged(weights, state.x, state.P) for weights in W.T]
                log_predicted = multiple_model.predicted_probabilities(state.log_mu, shared["pi"])
                expected = evidence(*zip(*mixtures, strict=True), log_predicted, z, shared)
                assert_close(answer.info.log_likelihood[k], expected)
                state, mean, cov = multiple_model.imm_step(state, z, **shared)
            case _:
                state, mean, cov = multiple_model.gpb2_step(state, z, **shared)
        assert_step(answer, world, k, mean, cov, np.exp(state.log_mu))
    n = len(world.model.motions)
    assert (answer.info.active_models == (n**2 if method == "gpb2" else n)).all()
    assert not (answer.info.status & int(FAILURE)).any()
    if method == "imm":
        assert_close(answer.state.beliefs.mean[-1], state.x)
        assert_close(answer.state.beliefs.cov[-1], state.P)


def test_an_empty_scan_moves_probabilities_by_the_chain():
    """Beliefs are predicted by each motion from the mixture, and the next scan goes on from there."""
    world = maneuver_world(maneuver(), 12)
    shared, state = fixed(world), start(world)
    models, pi = shared["models"], shared["pi"]
    answer = tracked(bank("imm"), world)
    assert not np.asarray(world.scans.mask).all()
    for k, z in enumerate(values(world)):
        if bool(world.scans.mask[k, 0]):
            state, mean, cov = multiple_model.imm_step(state, z, **shared)
        else:
            W = multiple_model.mixing_weights(state.log_mu, pi)
            starts = [multiple_model.merged(W[:, i], state.x, state.P) for i in range(len(models))]
            ahead = [kalman.predict(*belief, *model) for belief, model in zip(starts, models, strict=True)]
            log_mu = multiple_model.predicted_probabilities(state.log_mu, pi)
            state = multiple_model.State(*map(np.stack, zip(*ahead, strict=True)), log_mu)
            mean, cov = multiple_model.merged(np.exp(log_mu), state.x, state.P)
        assert_step(answer, world, k, mean, cov, np.exp(state.log_mu))


LMS = {"kind": "likely_model_set", "start": [f"m{k}" for k in range(1, 6)]}
THRESHOLDS = [(0.01, 0.3, 5), (0.1, 0.9, 5), (0.01, 0.1, 3)]


@pytest.mark.parametrize("rule", ["and", "or"])
@pytest.mark.parametrize(("low", "high", "keep"), THRESHOLDS, ids=str)
def test_likely_model_sets_are_those_of_the_textbook(rule, low, high, keep):
    """The same models are active at every step, before the measurement and after."""
    world = thirteen_world()
    settings = {**LMS, "unlikely_below": low, "principal_above": high, "keep": keep, "rule": rule}
    answer = tracked(settings, world)
    x, P = np.asarray(world.prior.mean), np.asarray(world.prior.cov)
    active = set(range(5))
    before, used = variable_structure.start(active, {0: 1.0}, x, P), set()
    for k, z in enumerate(values(world)):
        step = variable_structure.lms_cycle(active, before, z, **fixed(world), t1=low, t2=high, K=keep, rule=rule)
        before, active = step.posterior, step.next_active
        mu = [np.exp(before.log_mu.get(i, -np.inf)) for i in range(13)]
        assert_step(answer, world, k, step.mean, step.cov, mu)
        assert set(np.flatnonzero(answer.state.active[k])) == active
        assert answer.info.active_models[k] == len(before.log_mu)
        used |= set(before.log_mu)
    assert used > set(range(5))  # it was put to use
    assert answer.info.active_models.min() < 9


@pytest.mark.parametrize("rule", ["and", "or"])
def test_sets_grow_along_the_chain_not_against_it(rule):
    """A chain that cannot go back the way it came: a principal model brings those that it can switch to."""
    world = full_world(2)._replace(model=some_cannot_be())
    settings = {"kind": "likely_model_set", "unlikely_below": 0.02, "principal_above": 0.5, "keep": 2, "start": ["cv"]}
    answer = tracked({**settings, "rule": rule}, world)
    x, P, active = np.asarray(world.prior.mean), np.asarray(world.prior.cov), {0}
    before, sets = variable_structure.start(active, {0: 1.0}, x, P), set()
    for k, z in enumerate(values(world)):
        step = variable_structure.lms_cycle(active, before, z, **fixed(world), t1=0.02, t2=0.5, K=2, rule=rule)
        before, active = step.posterior, step.next_active
        assert_step(answer, world, k, step.mean, step.cov, [np.exp(before.log_mu.get(i, -np.inf)) for i in range(4)])
        assert set(np.flatnonzero(answer.state.active[k])) == active
        sets.add(tuple(sorted(active)))
    assert (0, 1) in sets


GROUPS = {
    "center": ["m1", "m2", "m3", "m4", "m5"], "right": ["m2", "m6", "m9", "m10"], "up": ["m3", "m6", "m7", "m11"],
    "left": ["m4", "m7", "m8", "m12"], "down": ["m5", "m8", "m9", "m13"],
}  # fmt: skip
MGS = {"kind": "model_group_switching", "groups": GROUPS}
BOUNDS = [(0.3, (0.1, 10.0), (0.1, 10.0)), (0.2, (0.1, 10.0), (0.5, 2.0)), (0.05, (0.5, 2.0), (1e-3, 1e3))]


@pytest.mark.parametrize(("activate", "ratio", "likelihood"), BOUNDS, ids=str)
def test_model_groups_are_those_of_the_textbook(activate, ratio, likelihood):
    """The same group and candidate at every step, and the same sum of likelihood ratios."""
    world = thirteen_world()
    bounds = {"activate_above": activate, "probability_bounds": list(ratio), "likelihood_bounds": list(likelihood)}
    answer = tracked({**MGS, **bounds}, world)
    groups = [{int(name[1:]) - 1 for name in group} for group in GROUPS.values()]
    x, P = np.asarray(world.prior.mean), np.asarray(world.prior.cov)
    state = variable_structure.MgsState(variable_structure.start(groups[0], {0: 1.0}, x, P), 0, None, 0.0)
    seen = set()
    for k, z in enumerate(values(world)):
        step = variable_structure.mgs_cycle(state, groups, z, **fixed(world), activation=activate, t1_mu=ratio[0],
                                            t2_mu=ratio[1], t1_L=likelihood[0], t2_L=likelihood[1])  # fmt: skip
        state = step.state
        mu = [np.exp(state.posterior.log_mu.get(i, -np.inf)) for i in range(13)]
        assert_step(answer, world, k, step.mean, step.cov, mu)
        assert answer.info.active_models[k] == len(step.used)
        assert answer.state.group[k] == state.group
        assert answer.state.candidate[k] == (state.group if state.candidate is None else state.candidate)
        following = groups[state.group] | (set() if state.candidate is None else groups[state.candidate])
        assert set(np.flatnonzero(answer.state.sets.active[k])) == following
        assert answer.state.log_ratio[k] == pytest.approx(state.log_ratio, rel=TIGHT, abs=TIGHT)
        seen.add((state.group, state.candidate))
    assert len(seen) > 3


@pytest.mark.parametrize("label", ["lms", "mgs"])
def test_an_empty_scan_changes_no_set(label):
    """Whatever its padding holds; the filters that ran are those that were active."""
    world, empty = thirteen_world(), np.array([3, 10, 11, 20, 30])
    mask = world.scans.mask.at[empty].set(False)
    world = world._replace(scans=world.scans._replace(mask=mask))
    if label == "lms":
        answer = tracked({**LMS, "unlikely_below": 0.01, "principal_above": 0.3, "keep": 5, "rule": "and"}, world)
        active = answer.state.active
    else:
        bounds = {"probability_bounds": [0.1, 10.0], "likelihood_bounds": [0.1, 10.0]}
        answer = tracked({**MGS, "activate_above": 0.3, **bounds}, world)
        active = answer.state.sets.active
    np.testing.assert_array_equal(active[empty], active[empty - 1])
    np.testing.assert_array_equal(answer.info.active_models[empty], active[empty].sum(axis=1))
    assert answer.info.active_models.max() > 5
    assert_close(probabilities(answer).sum(axis=1), np.ones(len(active)), 1e-12)
    assert not (answer.info.status & int(FAILURE)).any()


def test_variable_sets_of_all_models_are_the_imm_filter():
    """Nothing is unlikely, or both groups hold everything."""
    world = thirteen_world(1)
    names, expected = list(world.model.names), tracked(bank("imm"), world)
    everything = {**LMS, "start": names, "unlikely_below": 0.0, "principal_above": 0.9, "keep": 13}
    groups = {
        "kind": "model_group_switching", "groups": {"a": names, "b": names}, "activate_above": 0.3,
        "probability_bounds": [0.1, 10.0], "likelihood_bounds": [0.1, 10.0],
    }  # fmt: skip
    for settings in (everything, groups):
        answer = tracked(settings, world)
        assert (answer.info.active_models == 13).all()
        assert_close(answer.estimate.mean, expected.estimate.mean, 1e-12)
        assert_close(answer.estimate.cov, expected.estimate.cov, 1e-11)
        np.testing.assert_allclose(probabilities(answer), probabilities(expected), rtol=0, atol=1e-12)
        assert_close(answer.info.log_likelihood, expected.info.log_likelihood, 1e-12)
        assert_close(answer.info.nis, expected.info.nis, 1e-11)


UNREACHED = {
    "imm": bank("imm"), "gpb1": bank("gpb1"), "gpb2": bank("gpb2"), "static": bank("static"),
    "lms": {"kind": "likely_model_set", "unlikely_below": 0.0, "principal_above": 0.1, "keep": 4,
            "start": ["cv", "left", "right", "wide"]},
    "mgs": {"kind": "model_group_switching", "groups": {"a": ["cv", "left", "right", "wide"], "b": ["cv", "wide"]},
            "activate_above": 0.2, "probability_bounds": [1e-9, 1e9], "likelihood_bounds": [1e-9, 1e9]},
}  # fmt: skip


@pytest.mark.parametrize("label", UNREACHED)
def test_a_model_without_predecessor_never_comes_into_effect(label):
    """It has no probability, spoils no number, and leaves the other models what they are without it."""
    world = maneuver_world(some_cannot_be(), 12)
    answer = tracked(UNREACHED[label], world)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((answer.estimate, answer.info, answer.state)))
    assert (answer.estimate.modes["wide"] == 0.0).all()
    assert_close(probabilities(answer).sum(axis=1), np.ones(12), 1e-12)
    assert not (answer.info.status & int(FAILURE)).any()
    if label in ("imm", "gpb2"):
        without = tracked(UNREACHED[label] | {"motions": ["cv", "left", "right"]}, world)
        assert_close(answer.estimate.mean, without.estimate.mean, 1e-12)
        assert_close(answer.estimate.cov, without.estimate.cov, 1e-10)
        assert_close(answer.info.log_likelihood, without.info.log_likelihood, 1e-12)


def test_a_static_bank_loses_models_for_ever_but_for_its_floor():
    """After a long straight way, the turn has probability 0 and stays there; with a floor it comes back."""
    rng = np.random.default_rng(0)
    heading = np.concatenate([np.zeros(150), np.radians(4.0) * np.arange(1, 31)])
    way = np.cumsum(150.0 * np.stack([np.cos(heading), np.sin(heading)], 1), axis=0)
    world = world_of(maneuver(), [0, 0, 150, 0], np.diag([900, 900, 100, 100]), way + 30.0 * rng.normal(size=way.shape))
    plain, floored = tracked(bank("static"), world), tracked(bank("static", floor=1e-3), world)
    assert plain.estimate.modes["left"][149] == 0.0
    assert plain.estimate.modes["left"][-1] == 0.0
    assert floored.estimate.modes["left"][149] > 0.0


def test_permuting_the_models_permutes_the_answer():
    world = full_world(3)
    model, order = world.model, [2, 0, 3, 1]
    places = jnp.asarray(order)
    permuted = StateSpaceModel(
        tuple(model.motions[k] for k in order), model.measurement, model.transition[places][:, places],
        model.start[places], 0.0, model.point, tuple(model.names[k] for k in order),
    )  # fmt: skip
    answer, expected = tracked(bank("imm"), world._replace(model=permuted)), tracked(bank("imm"), world)
    assert_close(answer.estimate.mean, expected.estimate.mean, 1e-11)
    assert_close(answer.estimate.cov, expected.estimate.cov, 1e-10)
    for name in model.names:
        np.testing.assert_allclose(answer.estimate.modes[name], expected.estimate.modes[name], atol=1e-11)


def test_some_motions_of_a_model_are_a_model_of_their_own():
    """The chain never leaves them: rows of what is left sum to 1."""
    world, names = thirteen_world(), [f"m{k}" for k in range(1, 6)]
    whole = load_experiment(THIRTEEN).experiment.model
    rows = np.array(whole.transition_matrix)[:5, :5]
    given = whole.model_dump(exclude_none=True) | {
        "motions": {name: whole.motions[name].model_dump(exclude_none=True) for name in names},
        "switching": {"transition": (rows / rows.sum(axis=1, keepdims=True)).tolist()},
    }
    five = state_space_model(StateSpaceModelSettings.model_validate(given))
    answer = tracked(bank("imm", motions=names), world)
    expected = tracked(bank("imm"), world._replace(model=five))
    assert list(answer.estimate.modes) == sorted(names)
    assert_close(answer.estimate.mean, expected.estimate.mean, 1e-12)
    assert_close(answer.estimate.cov, expected.estimate.cov, 1e-11)
    np.testing.assert_allclose(probabilities(answer), probabilities(expected), atol=1e-12)


def test_motions_of_several_kinds_keep_their_places():
    """Those alike in structure are computed together."""
    motions = maneuver().motions
    groups = grouped(motions)
    assert sorted(group.places for group in groups) == [(0, 3), (1, 2)]
    parts = [jnp.asarray(group.places) for group in groups]
    np.testing.assert_array_equal(in_order(groups, parts), np.arange(4))
    turns = grouped([motions[1], motions[0], motions[2], motions[3]])
    np.testing.assert_array_equal(in_order(turns, [jnp.asarray(group.places) for group in turns]), np.arange(4))

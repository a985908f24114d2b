"""Slow textbook arithmetic of variable-structure multiple-model filters, with sets of model numbers.

X. R. Li and Y. Bar-Shalom, IEEE Trans. Autom. Control 41 (1996) 478-493 for the cycle; X. R. Li, X. Zhi and Y. Zhang,
IEEE Trans. Aerosp. Electron. Syst. 35 (1999) 225-241 for model-group switching (MGS); X. R. Li and Y. Zhang, IEEE
Trans. Aerosp. Electron. Syst. 36 (2000) 448-466 for the likely-model set (LMS); H. Azimian, "A Survey on Visual Object
Tracking Algorithms" (2005), Tables 4.1-4.3. Models, H, R and pi are those of ``multiple_model``; a model is known
by its place in the list, and whatever belongs to models is a dictionary with those numbers as keys.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference import kalman
from tests.reference.multiple_model import Models, log, log_sum_exp, merged

Array = NDArray[np.float64]


class Conditioned(NamedTuple):
    """One model after a scan: predicted log-probability, log-likelihood, mean, covariance."""

    log_predicted: float
    log_likelihood: float
    x: Array
    P: Array


class Posterior(NamedTuple):
    """The models in effect after a scan; an impossible one has log-probability -inf and no mean or covariance."""

    log_mu: dict[int, float]
    x: dict[int, Array]
    P: dict[int, Array]


Conditionals = dict[int, Conditioned | None]


def start(active: set[int], mu: dict[int, float], x: Array, P: Array) -> Posterior:
    """All active models start from one mean and covariance; those left out of mu have probability 0."""
    log_mu = {i: float(log(np.float64(mu.get(i, 0.0)))) for i in active}
    return Posterior(log_mu, dict.fromkeys(active, x), dict.fromkeys(active, P))


def conditioned(log_predicted: float, x: Array, P: Array, z: Array, H: Array, R: Array) -> Conditioned:
    """A model after the scan, from its predicted probability, mean and covariance."""
    x, P, log_likelihood, _ = kalman.update(x, P, z, H, R)
    return Conditioned(log_predicted, log_likelihood, x, P)


def cycle(now: set[int], before: Posterior, z: Array, models: Models, H: Array, R: Array, pi: Array) -> Conditionals:
    """VSIMM[now, before] up to the likelihoods: mix from the models of ``before`` only, predict, update.

    A model without admissible predecessor is None.
    """
    results: Conditionals = {}
    for i in now:
        log_joint = {j: float(log(pi[j, i])) + log_mu for j, log_mu in before.log_mu.items()}
        predecessors = [j for j in sorted(log_joint) if log_joint[j] > -np.inf]
        if not predecessors:
            results[i] = None
            continue
        log_predicted = log_sum_exp(np.array([log_joint[j] for j in predecessors]))
        weights = np.array([np.exp(log_joint[j] - log_predicted) for j in predecessors])
        x, P = merged(weights, [before.x[j] for j in predecessors], [before.P[j] for j in predecessors])
        results[i] = conditioned(log_predicted, *kalman.predict(x, P, *models[i]), z, H, R)
    return results


def posterior(results: Conditionals) -> Posterior:
    """Probabilities over the models of the results; what was predicted to leave them is shared out."""
    possible = {i: r for i, r in results.items() if r is not None}
    log_joint = {i: r.log_predicted + r.log_likelihood for i, r in possible.items()}
    total = log_sum_exp(np.array(list(log_joint.values())))
    log_mu = {i: log_joint[i] - total if i in possible else -np.inf for i in results}
    return Posterior(log_mu, {i: r.x for i, r in possible.items()}, {i: r.P for i, r in possible.items()})


def fused(after: Posterior) -> tuple[Array, Array]:
    """Mean and covariance over the models in effect."""
    members = sorted(after.x)
    weights = np.array([np.exp(after.log_mu[i]) for i in members])
    return merged(weights, [after.x[i] for i in members], [after.P[i] for i in members])


class LmsStep(NamedTuple):
    """Posterior of the models of the scan (the enlarged set), their fusion, and the sets found on the way."""

    posterior: Posterior
    mean: Array
    cov: Array
    unlikely: set[int]
    adjacent: set[int]
    next_active: set[int]


def lms_adapt(
    results: Conditionals, before: Posterior, z: Array, models: Models, H: Array, R: Array, pi: Array,
    t1: float, t2: float, K: int, rule: str = "and",
) -> LmsStep:  # fmt: skip
    """Table 4.3 from step 2 on, given the results of the active models.

    rule "and": unlikely models that are not adjacent from a principal one are deleted, the least probable first, as
    long as K remain. rule "or": every model goes that was unlikely or is not among the K best of the enlarged set,
    adjacent or not. Equal probabilities: the lower number goes first.
    """
    active = set(results)
    mu = {i: np.exp(v) for i, v in posterior(results).log_mu.items()}
    principal = {i for i in active if mu[i] > t2}
    unlikely = {i for i in active if mu[i] < t1}
    adjacent = {j for j in range(len(models)) if any(pi[p, j] > 0.0 for p in principal)}

    results = {**results, **cycle(adjacent - active, before, z, models, H, R, pi)}
    after = posterior(results)
    union = set(results)
    ascending = sorted(union, key=lambda i: (after.log_mu[i], i))
    if rule == "and":
        discardable = [i for i in ascending if i in unlikely - adjacent]
        deleted = set(discardable[: max(0, len(union) - K)])
    else:
        deleted = (unlikely | set(ascending[: max(0, len(union) - K)])) - {ascending[-1]}
    return LmsStep(after, *fused(after), unlikely, adjacent, union - deleted)


def lms_cycle(
    active: set[int], before: Posterior, z: Array, models: Models, H: Array, R: Array, pi: Array,
    t1: float, t2: float, K: int, rule: str = "and",
) -> LmsStep:  # fmt: skip
    """One scan of the likely-model-set filter; the next one mixes from all models of this one's posterior."""
    results = cycle(active, before, z, models, H, R, pi)
    return lms_adapt(results, before, z, models, H, R, pi, t1, t2, K, rule)


class MgsState(NamedTuple):
    """Posterior of the last scan, group in effect, candidate beside it (None: not in union), log-ratio sum."""

    posterior: Posterior
    group: int
    candidate: int | None
    log_ratio: float


class MgsStep(NamedTuple):
    """State for the next scan, fusion, and the models of this scan."""

    state: MgsState
    mean: Array
    cov: Array
    used: set[int]


def group_log_likelihood(group: set[int], results: Conditionals) -> float:
    """log of sum L_i mu^_i / sum mu^_i over a group, mu^ the predicted probabilities."""
    members = [r for i, r in results.items() if i in group and r is not None]
    joint = log_sum_exp(np.array([r.log_predicted + r.log_likelihood for r in members]))
    return joint - log_sum_exp(np.array([r.log_predicted for r in members]))


def group_log_probability(group: set[int], after: Posterior) -> float:
    """log of sum mu_i over a group."""
    return log_sum_exp(np.array([v for i, v in after.log_mu.items() if i in group]))


def mgs_cycle(
    state: MgsState, groups: list[set[int]], z: Array, models: Models, H: Array, R: Array, pi: Array,
    activation: float, t1_mu: float, t2_mu: float, t1_L: float, t2_L: float,
) -> MgsStep:  # fmt: skip
    """Table 4.2, one scan. Group j is a candidate by the probability of the models it shares with the one in effect.

    The best candidate (the first of equals) is activated if that exceeds ``activation``. In union, the candidate or
    the old group is given up by the tests of step 5, already at the scan of the activation; no third group enters.
    """
    old, candidate, log_ratio = state.group, state.candidate, state.log_ratio
    now = groups[old] if candidate is None else groups[old] | groups[candidate]
    results = cycle(now, state.posterior, z, models, H, R, pi)
    after = posterior(results)

    if candidate is None:
        shared = {j: groups[old] & groups[j] for j in range(len(groups)) if j != old}
        score = {j: sum(np.exp(after.log_mu[i]) for i in members) for j, members in shared.items()}
        best = max(score, key=lambda j: (score[j], -j))
        if score[best] > activation:
            candidate, log_ratio = best, 0.0
            results = {**results, **cycle(groups[best] - now, state.posterior, z, models, H, R, pi)}
            after = posterior(results)

    if candidate is not None:
        log_mu_ratio = group_log_probability(groups[candidate], after) - group_log_probability(groups[old], after)
        L_candidate, L_old = (group_log_likelihood(groups[g], results) for g in (candidate, old))
        log_ratio = log_ratio + L_candidate - L_old
        if log_mu_ratio < np.log(t1_mu) or log_ratio < np.log(t1_L):
            candidate, log_ratio = None, 0.0
        elif log_mu_ratio > np.log(t2_mu) and log_ratio > np.log(t2_L):
            old, candidate, log_ratio = candidate, None, 0.0
    return MgsStep(MgsState(after, old, candidate, log_ratio), *fused(after), set(results))

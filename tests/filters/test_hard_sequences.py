"""Hard sequences: bad input, gaps, extreme priors, noise, shapes and units, through every guarded filter.

At every step all reported numbers are finite, covariances exactly symmetric and positive definite, semi-axes
positive. Where the sequence has an answer, the last estimate is within 1,000 standard deviations of one
measurement of the truth and the guard did not act; where it has none, a status bit says so.
"""

from dataclasses import dataclass, field
from functools import cache

import jax
import numpy as np
import pytest

from emt.filters.base import TrackingModel
from emt.filters.feldmann import FeldmannSettings
from emt.filters.mem_ekf_star import MemEkfStarSettings
from emt.linalg import Sym2
from emt.models.motion import WhiteAcceleration
from emt.status import FAILURE, Status
from emt.types import Ellipse, Measurements, Prior, StarConvex
from tests.filters.cases import (
    GP,
    MAIN,
    MEM_COV,
    MEM_NOISE,
    VB,
    Case,
    Problem,
    batch_tracker,
    cast,
    extent_matrices,
    stack,
)

STEPS, SLOTS = 24, 14


@dataclass(frozen=True)
class Sequence:
    """A hard sequence. Lengths are in units of `unit` metres."""

    name: str
    counts: object = 8
    """Points per scan, or one number per scan."""
    axes: tuple[float, float] = (6.0, 2.5)
    angle: float = 0.4
    noise: tuple[float, float, float] = (0.04, 0.0, 0.04)
    """Sensor noise: xx, xy, yy."""
    velocity: tuple[float, float] = (1.0, 0.5)
    origin: tuple[float, float] = (0.0, 0.0)
    dt: object = 1.0
    psd: float = 0.1
    prior_axes: tuple[float, float] = (5.0, 3.0)
    prior_turn: float = 0.2
    prior_cov: object = (4.0, 4.0, 1.0, 1.0)
    """Variances or a full matrix."""
    prior_offset: tuple[float, float] = (1.0, -1.0)
    unit: float = 1.0
    settings: str = "usual"
    corrupt: object = None
    """(points, mask, truth, generator) -> None, in place."""
    answer: bool = True
    """Whether the published algorithms have an answer; without, a bit of `flag` must be set."""
    flag: Status = field(default=Status(127))


def settings_of(case: Case, which: str):
    """By name: usual, forgetful (of nearly everything at each step), or stubborn (sure of the shape)."""
    label = case.label
    if which == "usual" or (label == "gp_ett" and which == "stubborn"):
        return case.settings
    forgetful = which == "forgetful"
    match label:
        case "vb_random_matrix":
            update = {"forgetting": 0.05, "orientation_noise": 1.0} if forgetful else {"shape": (1e8, 1e8)}
            return VB.model_copy(update=update)
        case "mem_ekf_star":
            big, small = 100.0 * np.array(MEM_NOISE), 1e-8 * np.array(MEM_COV)
            return MemEkfStarSettings(
                shape_cov=MEM_COV if forgetful else small.tolist(),
                shape_noise=(big if forgetful else 0 * big).tolist(),
            )
        case "feldmann":
            decay = {"kind": "time_constant", "time": 0.05 if forgetful else 1e9}
            return FeldmannSettings(weight=9.0 if forgetful else 1e8, decay=decay)
        case _:
            return GP.model_copy(update={"forgetting_rate": 5.0, "turn_acceleration_psd": 1.0})


def scans_of(sequence: Sequence, source: str, seed: int):
    """Points, mask, true centres and steps in units of the sequence."""
    rng = np.random.default_rng(seed)
    dt = np.broadcast_to(np.asarray(sequence.dt, np.float64), STEPS)
    counts = np.broadcast_to(np.asarray(sequence.counts), STEPS)
    truth = np.array(sequence.origin) + np.cumsum(dt)[:, None] * np.array(sequence.velocity)
    c, s = np.cos(sequence.angle), np.sin(sequence.angle)
    around = rng.uniform(0.0, 2.0 * np.pi, (STEPS, SLOTS))
    radius = np.sqrt(rng.uniform(size=(STEPS, SLOTS))) if source == "filled" else np.ones((STEPS, SLOTS))
    body = np.stack([sequence.axes[0] * radius * np.cos(around), sequence.axes[1] * radius * np.sin(around)], -1)
    xx, xy, yy = sequence.noise
    l11 = np.sqrt(xx)
    l21 = xy / l11 if l11 > 0.0 else 0.0
    chol = np.array([[l11, 0.0], [l21, np.sqrt(max(yy - l21**2, 0.0))]])
    points = truth[:, None] + body @ np.array([[c, s], [-s, c]]) + rng.normal(size=(STEPS, SLOTS, 2)) @ chol.T
    mask = np.arange(SLOTS) < counts[:, None]
    if sequence.corrupt is not None:
        sequence.corrupt(points, mask, truth, rng)
    return points, mask, truth, dt


def problem_of(case: Case, sequence: Sequence, seed: int) -> Problem:
    points, mask, _, dt = scans_of(sequence, case.source, seed)
    u = sequence.unit
    cov = np.asarray(sequence.prior_cov, np.float64)
    cov = np.diag(cov) if cov.ndim == 1 else cov
    start = np.array([*np.add(sequence.origin, sequence.prior_offset), *sequence.velocity])
    prior = Prior(
        u * start,
        u**2 * cov,
        Ellipse(u * np.array(sequence.prior_axes), np.asarray(sequence.angle + sequence.prior_turn)),
    )
    noise = Sym2(*(u**2 * np.asarray(entry) for entry in sequence.noise))
    model = TrackingModel(WhiteAcceleration(np.asarray(u**2 * sequence.psd)), noise, np.asarray(0.25))
    params = case.in_units(case.params(settings_of(case, sequence.settings)), u, 1.0)
    world = cast((model, prior, Measurements(u * points, mask, np.zeros(STEPS, bool)), dt), np.float64)
    return Problem(params, *world)


def put(step, value, slot=0, coordinate=slice(None)):
    """Replaces a point (of one or several scans) by a value."""

    def corrupt(points, mask, truth, rng):
        points[step, slot, coordinate] = value
        mask[step, slot] = True

    return corrupt


def shift_scans(steps, offset):
    """Displaces whole scans."""

    def corrupt(points, mask, truth, rng):
        points[steps] += np.asarray(offset)

    return corrupt


def at_centre(points, mask, truth, rng):
    points[:] = truth[:, None]


def on_a_line(points, mask, truth, rng):
    points[..., 1] = points[..., 0] - truth[:, None, 0] + truth[:, None, 1]


def same_point(points, mask, truth, rng):
    points[:] = points[:, :1]


def fixed_point(points, mask, truth, rng):
    points[:], truth[:] = points[0, 0], points[0, 0]


def two_clusters(points, mask, truth, rng):
    points[:, ::2] += 40.0
    points[:, 1::2] -= 40.0


def shared_scan(points, mask, truth, rng):
    points[:], truth[:] = points[0], truth[0]


def nothing_but_nan(points, mask, truth, rng):
    points[:] = np.nan


def _only(*steps, n=8):
    """`n` points at these steps, none at the others."""
    counts = np.zeros(STEPS, int)
    counts[list(steps)] = n
    return tuple(counts)


def _gap(start, stop, n=8):
    counts = np.full(STEPS, n)
    counts[start:stop] = 0
    return tuple(counts)


def _full(correlation: float):
    """Prior covariance with correlated position and velocity on each axis."""
    cov = np.diag([4.0, 4.0, 1.0, 1.0])
    cov[0, 2] = cov[2, 0] = cov[1, 3] = cov[3, 1] = 2.0 * correlation
    return cov


SKIPPED, GROSS = Status.MEASUREMENT_SKIPPED, Status.GROSS_INNOVATION
S = Sequence
SEQUENCES = [
    S("ordinary"),
    # non-finite coordinates
    S("one NaN coordinate", corrupt=put(7, np.nan, coordinate=0)),
    S("one NaN point", corrupt=put(7, np.nan)),
    S("one infinite point", corrupt=put(7, np.inf)),
    S("one point at minus infinity", corrupt=put(7, -np.inf, coordinate=1)),
    S("NaN in every scan", corrupt=put(slice(None), np.nan, slot=2)),
    S("NaN in the first scan", corrupt=put(0, np.nan)),
    S("NaN in the last scan", corrupt=put(-1, np.nan)),
    S("whole scan NaN", corrupt=put(5, np.nan, slot=slice(None))),
    S("whole last scan NaN", corrupt=put(-1, np.nan, slot=slice(None))),
    S("nothing but NaN", corrupt=nothing_but_nan, answer=False, flag=SKIPPED),
    S("NaN as the only point", counts=1, corrupt=put(slice(3, 9), np.nan)),
    # gross outliers; the screen takes those of 1e76 and beyond
    *(S(f"outlier 1e{e}", corrupt=put(8, 10.0**e), answer=False, flag=GROSS)
      for e in (3, 4, 6, 9, 12, 20, 50, 70)),
    *(S(f"outlier 1e{e}", corrupt=put(8, -(10.0**e)), flag=SKIPPED) for e in (77, 150, 300, 308)),
    S("outlier in the first scan", corrupt=put(0, 1e7), answer=False, flag=GROSS),
    S("outlier in the last scan", corrupt=put(-1, 1e7), answer=False, flag=GROSS),
    S("outlier in every third scan", corrupt=put(slice(0, None, 3), 1e5), answer=False, flag=GROSS),
    S("outlier as the only point", counts=1, corrupt=put(8, 1e6), answer=False, flag=GROSS),
    S("opposite outliers", corrupt=put(8, [[1e8, 1e8], [-1e8, -1e8]], slot=slice(0, 2)), answer=False,
      flag=GROSS),
    S("whole scan displaced", corrupt=shift_scans(8, 1e6), answer=False, flag=GROSS),
    S("object jumps", corrupt=shift_scans(slice(8, 14), 500.0), answer=False, flag=GROSS),
    # empty scans
    S("first scan empty", counts=_gap(0, 1)),
    S("ten empty scans first", counts=_gap(0, 10)),
    S("last scan empty", counts=_gap(STEPS - 1, STEPS)),
    S("ten empty scans last", counts=_gap(STEPS - 10, STEPS)),
    S("long gap", counts=_gap(2, 22)),
    S("every second scan empty", counts=(8, 0) * (STEPS // 2)),
    S("nothing at all", counts=0),
    S("one scan only", counts=_only(0)),
    S("last scan only", counts=_only(STEPS - 1)),
    S("hour-long gap", dt=(1.0,) * 10 + (3600.0,) + (1.0,) * (STEPS - 11), corrupt=None),
    # sparse data
    S("one point per scan", counts=1),
    S("two points per scan", counts=2),
    S("one point in every fifth scan", counts=_only(*range(0, STEPS, 5), n=1)),
    S("one point at all", counts=_only(0, n=1)),
    S("one point, sure of the shape", counts=1, settings="stubborn"),
    # forgetting
    S("strong forgetting", settings="forgetful"),
    S("strong forgetting, one point", settings="forgetful", counts=1),
    S("strong forgetting, gap", settings="forgetful", counts=_gap(3, 21)),
    S("strong forgetting, nothing", settings="forgetful", counts=0),
    # sensor noise
    S("tiny noise", noise=(1e-8, 0.0, 1e-8)),
    S("vanishing noise", noise=(1e-30, 0.0, 1e-30)),
    S("no noise", noise=(0.0, 0.0, 0.0)),
    S("no noise on one axis", noise=(0.04, 0.0, 0.0)),
    S("large noise", noise=(1e4, 0.0, 1e4)),
    S("huge noise", noise=(1e12, 0.0, 1e12)),
    S("noise of one direction", noise=(1e4, 0.0, 1e-4)),
    S("noise fully correlated", noise=(1.0, 0.999999999, 1.0)),
    # needles
    S("needle", axes=(1000.0, 1.0), prior_axes=(1000.0, 1.0), prior_turn=0.01),
    S("needle along x", axes=(1000.0, 1.0), prior_axes=(1000.0, 1.0), angle=0.0, prior_turn=0.0),
    S("needle across", axes=(1.0, 1000.0), prior_axes=(1.0, 1000.0), prior_turn=0.01),
    S("needle with a turned prior", axes=(1000.0, 1.0), prior_axes=(1000.0, 1.0), prior_turn=1.5),
    S("needle from a circle", axes=(1000.0, 1.0), prior_axes=(30.0, 30.0)),
    S("circle from a needle", axes=(6.0, 6.0), prior_axes=(1000.0, 1.0)),
    S("needle without noise", axes=(1000.0, 1.0), prior_axes=(1000.0, 1.0), noise=(1e-12, 0.0, 1e-12)),
    # priors
    S("huge prior covariance", prior_cov=(1e12, 1e12, 1e12, 1e12)),
    S("vast prior covariance", prior_cov=(1e20, 1e20, 1e20, 1e20)),
    S("tiny prior covariance", prior_cov=(1e-12, 1e-12, 1e-12, 1e-12), prior_offset=(0.0, 0.0)),
    S("tiny prior covariance, wrong", prior_cov=(1e-12, 1e-12, 1e-12, 1e-12), psd=1e-6),
    S("prior of one axis", prior_cov=(1e8, 1e-8, 1e8, 1e-8), prior_offset=(1e3, 0.0)),
    S("velocity unknown", prior_cov=(4.0, 4.0, 1e12, 1e12)),
    S("velocity known", prior_cov=(1e12, 1e12, 1e-9, 1e-9)),
    S("correlated prior", prior_cov=_full(0.9999999)),
    S("anticorrelated prior", prior_cov=_full(-0.9999999)),
    S("prior far away", prior_offset=(1e4, -1e4), answer=False, flag=GROSS),
    S("prior far away and unsure", prior_offset=(1e4, -1e4), prior_cov=(1e9, 1e9, 1.0, 1.0)),
    S("prior turned by 90 degrees", prior_turn=np.pi / 2),
    S("prior turned by 180 degrees", prior_turn=np.pi),
    S("prior turned by 3 rad", prior_turn=3.0),
    S("prior turned many times", prior_turn=1e3),
    S("prior axes tiny", prior_axes=(1e-6, 1e-6)),
    S("prior axes huge", prior_axes=(1e5, 1e5)),
    S("prior axes exchanged", prior_axes=(2.5, 6.0)),
    S("prior a circle", prior_axes=(4.0, 4.0), prior_turn=0.0),
    # degenerate points
    S("all points at the centre", corrupt=at_centre),
    S("all points at the centre, huge axes", corrupt=at_centre, prior_axes=(60.0, 60.0)),
    S("all points of a scan equal", corrupt=same_point),
    S("one point for ever", corrupt=fixed_point, psd=1e-4, velocity=(0.0, 0.0)),
    S("one point for ever, no noise", corrupt=fixed_point, psd=1e-4, velocity=(0.0, 0.0),
      noise=(1e-20, 0.0, 1e-20)),
    S("the same scan for ever", corrupt=shared_scan, velocity=(0.0, 0.0)),
    S("points on a line", corrupt=on_a_line),
    S("points on a line, no noise", corrupt=on_a_line, noise=(1e-16, 0.0, 1e-16)),
    S("two clusters", corrupt=two_clusters),
    S("full scans", counts=SLOTS),
    # shapes along the axes
    S("ellipse along x", angle=0.0, prior_turn=0.0),
    S("ellipse along y", angle=np.pi / 2, prior_turn=0.0),
    S("ellipse turned many times", angle=1e4),
    S("circle", axes=(4.0, 4.0), prior_axes=(4.0, 4.0)),
    # places, units and motion
    S("map coordinates", origin=(5e5, 5.4e6)),
    S("coordinates of 1e9", origin=(1e9, -1e9)),
    S("coordinates of 1e12", origin=(1e12, 1e12)),
    S("micrometres", unit=1e-6),
    S("megametres", unit=1e6),
    S("fast", velocity=(1e5, -1e5)),
    S("tiny steps", dt=1e-6),
    S("vanishing steps", dt=1e-12),
    S("long steps", dt=1e3),
    S("vast steps", dt=1e7),
    S("steps of all lengths", dt=tuple(10.0 ** np.linspace(-6, 4, STEPS))),
    S("no process noise", psd=0.0),
    S("huge process noise", psd=1e12),
    S("vanishing process noise", psd=1e-30),
]  # fmt: skip


@cache
def answers(case: Case):
    """Estimates and status of all sequences, with leading axes sequence and step."""
    problems = [problem_of(case, sequence, seed) for seed, sequence in enumerate(SEQUENCES)]
    estimate, info = batch_tracker(case)(stack(problems))
    return jax.tree.map(np.asarray, (estimate, info))


def faults(case: Case, index: int) -> list[str]:
    """Everything the sequence's answer breaks of the promise."""
    sequence = SEQUENCES[index]
    estimate, info = jax.tree.map(lambda leaf: leaf[index], answers(case))
    status = int(np.bitwise_or.reduce(info.status))
    found = []
    leaves = [*jax.tree.leaves(estimate), info.nis, info.log_likelihood]
    if not all(np.isfinite(leaf).all() for leaf in leaves):
        found.append("not finite")
    std = np.sqrt(np.abs(np.diagonal(estimate.cov, axis1=1, axis2=2)))
    correlation = estimate.cov / np.maximum(std[:, :, None] * std[:, None, :], 1e-300)
    if np.abs(estimate.cov - np.swapaxes(estimate.cov, 1, 2)).max() != 0.0:
        found.append("covariance not symmetric")
    if not (np.diagonal(estimate.cov, axis1=1, axis2=2) > 0.0).all():
        found.append("variance not positive")
    # a covariance of correlation 1 - 1e-16 cannot be told from a singular one once it is written as a matrix
    elif np.isfinite(correlation).all() and (low := np.linalg.eigvalsh(correlation).min()) < -ROUNDING:
        found.append(f"covariance not definite ({low:.1e})")
    if not isinstance(estimate.shape, StarConvex) and not (estimate.shape.semi_axes > 0.0).all():
        found.append("semi-axis not positive")
    names = ", ".join(Status.names_of(status))
    if sequence.answer:
        _, _, truth, _ = scans_of(sequence, case.source, index)
        xx, xy, yy = sequence.noise
        spread = 0.25 * extent_matrices(sequence.axes, sequence.angle) + np.array([[xx, xy], [xy, yy]])
        error = np.linalg.norm(estimate.mean[-1, :2] / sequence.unit - truth[-1])
        limit = 1000.0 * np.sqrt(np.linalg.eigvalsh(spread)[-1])
        if not error < limit:
            found.append(f"final error {error:.2g} beyond {limit:.2g} (status: {names})")
        if status & int(FAILURE):
            steps = np.flatnonzero(info.status & int(FAILURE))
            found.append(f"the guard acted at steps {steps[:5]} (status: {names})")
    elif not status & sequence.flag:
        found.append(f"no flag (status: {names})")
    return found


ROUNDING = 1e-15
"""Smallest eigenvalue of a reported correlation matrix: -4 units of rounding."""


def test_there_are_enough_of_them():
    labels = [sequence.name for sequence in SEQUENCES]
    assert len(set(labels)) == len(labels) >= 60


@pytest.mark.parametrize("index", range(len(SEQUENCES)), ids=[sequence.name for sequence in SEQUENCES])
@pytest.mark.parametrize("case", MAIN, ids=str)
def test_hard_sequence(case, index):
    assert faults(case, index) == []

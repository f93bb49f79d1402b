"""One contract for every term: rows per frame, finite, and gradients that central differences confirm."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import motionfit as mf
from motionfit import samples
from motionfit._motion import host_kinematics, rest_motion
from motionfit.adapt import build_clearance
from motionfit.adapt._clearance import row_depths
from motionfit.adapt._groups import GROUPS, Meetings, known_depths
from motionfit.adapt._sampling import sampling
from motionfit.adapt._touches import KEPT, hold_term, touches_held
from motionfit.metrics import nearest_on_skin
from motionfit.shape.pairs import Pair, pairs_of
from motionfit.splines import bspline_basis
from motionfit.terms.penetration import hinge
from tests.helpers import central_difference
from tests.test_touches import touches_in

RELATIVE = 1e-4  # analytic against central differences in double precision


def _problem(term, character, motion, joints=("left_upper_arm", "right_thigh", "left_forearm")):
    basis = bspline_basis(motion.frame_count, float(motion.dt), 0.1)
    axes = ([0.0, 0.0, 1.0], [0.3, 0.2, 0.9], [1.0, 0.0, 0.0])
    controls = tuple(
        mf.Control(role, (mf.Drive(character.skeleton.joint(role), np.array(axis) / np.linalg.norm(axis), 1.0),), basis)
        for role, axis in zip(joints, axes, strict=True)
    )
    return mf.Problem(character, motion, {"term": term}, controls)


def signed_depths(clearance, kin):
    """Depth [m] per frame and pair, negative for a gap."""
    rows = np.asarray(row_depths(clearance.term, kin))
    owner = np.array(clearance.pair_of_row)
    return np.stack([rows[:, owner == k].max(axis=1) for k in range(len(clearance.pairs))], axis=1)


def _terms(character, motion):
    kin = mf.forward_kinematics(character.skeleton, motion)
    frames = motion.frame_count
    for objective in ("vertex", "capsule", "joint"):
        for block in ("arms", "legs"):
            clearance = build_clearance(character, pairs_of(block), objective)
            # within a hair of first contact: half of the pairs just touch, half just do not
            depth = signed_depths(clearance, kin)
            touching = depth - 1e-4 * np.where(np.arange(depth.shape[1]) % 2 == 0, 1.0, -1.0)
            yield f"{objective}-{block}-contact", clearance.allowing(touching)
            yield f"{objective}-{block}-deep", clearance.allowing(np.full_like(depth, -0.05))
    _, touches = touches_in(character, motion, frames, looks=(1, 4))
    yield "touches-contact", eqx.tree_at(lambda t: t.allowed, touches, np.asarray(touches.depth(kin)) - 1e-4)
    yield "touches-deep", eqx.tree_at(lambda t: t.allowed, touches, np.full((frames, KEPT), -0.05))
    hand = (character.skeleton.joint("left_hand"),)
    yield "joint-tracking", mf.terms.JointTracking(hand, np.zeros((frames, 1, 3)), 0.1)
    yield "rotation-tracking", mf.terms.RotationTracking(hand, np.asarray(kin.rotations_world[:, hand]), 0.1)
    yield "effort", mf.terms.Effort(np.array([0.5, 1.0, 2.0]))
    yield "smoothness", mf.terms.Smoothness(5.0)
    yield "steadiness", mf.terms.Steadiness(np.array([0.5, 1.0, np.inf]))
    yield "robust", mf.Robust(mf.terms.Effort(0.01), 2.0)
    yield "during", mf.During(mf.terms.Smoothness(5.0), np.linspace(0, 1, frames))
    yield "custom", mf.Custom(_level, 0.9)
    for kind in ("contact", "deep"):
        yield f"meetings-{kind}", _meetings(character, motion, kind)
    hold = _hold(character, motion)
    yield "hold-contact", eqx.tree_at(lambda t: t.gap, hold, np.asarray(hold.distance(kin)) - 1e-4)
    yield "hold-lost", eqx.tree_at(lambda t: t.gap, hold, np.asarray(hold.distance(kin)) - 0.05)


def _hold(character, motion):
    """Both hands at thighs and head, each frame by the nearest of two looks."""
    pairs = tuple(Pair(f"{side}_hand", part, "") for side in ("left", "right") for part in (f"{side}_thigh", "head"))
    wanted = np.zeros((motion.frame_count, len(pairs)), bool)
    wanted[1] = wanted[4] = True
    frames, rows = np.nonzero(wanted)
    touches = touches_held(character, host_kinematics(motion)[1][frames], rows,
                           nearest_on_skin(character, motion, pairs, wanted))  # fmt: skip
    weight = np.full(wanted.shape, 0.5)
    return hold_term(character, touches, frames, 2, np.zeros(wanted.shape), weight, motion.frame_count)[0]


def _meetings(character, motion, kind):
    """Both hands against the thighs and the head: within a hair of the depth that counts, or deeper and apart too."""
    known, at = known_depths(character, GROUPS[1:8:2]), sampling(motion, 2 / 60)
    at = at._replace(rows=np.arange(motion.frame_count))
    depths, meetings = known.depths(motion), Meetings(known, at)
    meetings.seen(known.probe_depths(motion), np.zeros(depths.shape), depths)
    free = depths - 1e-4 * np.where(np.arange(depths.shape[1]) % 2 == 0, 1.0, -1.0)
    gap = -free if kind == "contact" else -depths - 0.03
    term = meetings.term(free, gap, np.full(depths.shape, 0.5))
    return term if kind == "contact" else eqx.tree_at(lambda t: t.allowed, term, np.full(len(term.allowed), -0.05))


def _level(kin, height):
    return (kin.positions_world[:, 0, 1] - height) / 0.05 + kin.positions_world[:, 20, 0] ** 2


NAMES = [f"{o}-{b}-{k}" for o in ("vertex", "capsule", "joint") for b in ("arms", "legs") for k in ("contact", "deep")]
NAMES += [
    "touches-contact",
    "touches-deep",
    "joint-tracking",
    "rotation-tracking",
    "effort",
    "smoothness",
    "robust",
    "during",
    "custom",
    "meetings-contact",
    "meetings-deep",
    "hold-contact",
    "hold-lost",
]


@pytest.fixture(scope="module")
def cases(heavy):
    motion = mf.onto(samples.walk(cycles=1), heavy.skeleton)[:6]
    still = rest_motion(heavy.skeleton)[np.zeros(6, int)]  # degenerate: bind pose, all limbs straight, at rest
    return {kind: (m, dict(_terms(heavy, m))) for kind, m in (("walk", motion), ("bind", still))}


@pytest.mark.parametrize("pose", ["walk", "bind"])
@pytest.mark.parametrize("name", NAMES)
def test_contract(cases, heavy, name, pose):
    motion, terms = cases[pose]
    problem = _problem(terms[name], heavy, motion)
    sizes = [c.basis.count for c in problem.controls]
    rng = np.random.default_rng(3)
    start = rng.normal(size=sum(sizes)) * 0.003

    term = problem.terms["term"]
    assert isinstance(term, mf.Term)

    def cost(x):
        parts = jnp.split(jnp.asarray(x), np.cumsum(sizes)[:-1])
        signals = jnp.stack([c.signal(p) for c, p in zip(problem.controls, parts, strict=True)], axis=1)
        return 0.5 * jnp.sum(term.residual(problem.kinematics(signals)) ** 2)

    rows = term.residual(problem.kinematics(jnp.zeros((motion.frame_count, 3))))
    assert rows.shape[0] == motion.frame_count and np.isfinite(rows).all()
    cost = jax.jit(cost)
    for x in (np.zeros_like(start), start):
        gradient = np.asarray(jax.grad(cost)(x))
        expected = central_difference(cost, x)
        assert np.isfinite(gradient).all()
        scale = max(np.abs(expected).max(), 1e-6)
        np.testing.assert_allclose(gradient, expected, atol=RELATIVE * scale + 1e-7)


def test_hinge_is_zero_inside_and_once_differentiable():
    x = jnp.array([-1.0, -1e-9, 0.0, 1e-3, 2e-3, 5e-3])
    np.testing.assert_allclose(hinge(x, 2e-3), [0, 0, 0, 2.5e-4, 1e-3, 4e-3], atol=1e-15)
    slope = jax.vmap(jax.grad(lambda v: hinge(v, 2e-3)))(x)
    np.testing.assert_allclose(slope, [0, 0, 0, 0.5, 1.0, 1.0], atol=1e-9)


def test_robust_equals_the_pseudo_huber_loss(heavy):
    motion = rest_motion(heavy.skeleton)[np.zeros(4, int)]
    signals = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)))
    kin = mf.forward_kinematics(heavy.skeleton, motion, signals)
    plain, robust = mf.terms.Effort(0.1), mf.Robust(mf.terms.Effort(0.1), 1.5)
    r = plain.residual(kin)
    np.testing.assert_allclose(robust.residual(kin) ** 2 / 2, 1.5**2 * (jnp.sqrt(1 + (r / 1.5) ** 2) - 1), atol=1e-12)

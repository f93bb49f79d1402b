"""How an adapted clip changes as a body part grows: the derivative of the fit with respect to girth.

A fit makes choices that are no smooth function of the body: which vertices are probes, which of them the solver sees,
which pairs are left alone, what the rounds took off, about which axes the controls turn. `Held` holds them, so that
the fit's problem becomes a smooth function P(s) of a part's scale s. Its set-up (skin, depth fields, volumes, what the
reference shows) runs on the host and is differenced, which costs no solve; the solve is differentiated exactly. At an
optimum x of the cost C, dC/dx = 0, and so, by the implicit function theorem,

    dx/ds = -(d2C / dx dx)^-1 (d2C / dx dP) dP/ds,

with the Hessian of the cost itself, not its Gauss-Newton part, banded in time like the solve.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int
from scipy.ndimage import correlate1d, spline_filter
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from motionfit._character import Character
from motionfit._control import Correction
from motionfit._fit import Fit
from motionfit._fit import fit as refit
from motionfit._motion import Motion, host_kinematics, rest_motion
from motionfit._onto import onto
from motionfit._problem import Energy, Problem
from motionfit._programs import program
from motionfit._skeleton import SIDES
from motionfit._solve import Work, banded_solver, block_work
from motionfit._types import InputError
from motionfit.adapt._clearance import Clearance, build_clearance, volume_depths
from motionfit.adapt._limbs import LIMBS
from motionfit.adapt._stages import ALLOWED_EXCESS, SOLVE_PROBES, Stage
from motionfit.adapt._stages import stages_of as limb_stages
from motionfit.adapt._touches import touching_on
from motionfit.banded import Banded
from motionfit.metrics import skin_depths
from motionfit.shape.field import DepthField, standing, standing_vertices
from motionfit.shape.growth import grow
from motionfit.shape.pairs import pairs_of
from motionfit.shape.probes import Probes
from motionfit.shape.surface import part_surface
from motionfit.shape.volumes import allocate_vertices, fit_volumes
from motionfit.terms.penetration import CapsuleClearance, SkinClearance, TouchClearance

MAX_STEPS = 200
WAYS = (1.0, -1.0)
NAMES = {"arms": tuple(f"{side}_arm" for side in SIDES), "legs": ("legs",)}

Change = dict[str, dict[str, np.ndarray]]
Seen = SkinClearance | CapsuleClearance  # the objectives that see shapes


def girth_derivative(
    fit: Fit,
    parts: Sequence[str] = ("arms", "legs", "trunk"),
    *,
    reference: Character | None = None,
    of_reference: bool = False,
    tolerance: float = 1e-5,
) -> Change:
    """The derivative of a fit's control points with respect to how thick body parts are.

    `fit` is a result of `motionfit.adapt` or `motionfit.adapt.limbs` with the arms or the legs among its blocks, and
    `reference` the one that it was made with. `parts` are those of `motionfit.shape.grow`; all of them share one
    solve. The result names the part, then the control: `change["trunk"]["left_arm"]` [rad] per unit of the scale that
    `grow(fit.problem.character, {"trunk": scale})` takes, at scale 1. With `of_reference` it is the reference that
    grows, and with it the overlap that does not count. Blocks after the limbs are not looked through.

    It is computed in double precision whatever JAX's mode is: differences of single-precision slopes are noise. The
    fit is first solved on to `tolerance`, relative and absolute. `motionfit.adapt.predict` takes a step. Where the
    skin's active points change much the derivative holds for a per cent or two.
    """
    if of_reference and reference is None:
        raise InputError("of_reference= asks how the reference grows; give reference=")
    with jax.enable_x64(True):
        double = jax.tree.map(_double, (fit.correction, fit.problem))
        fit = dataclasses.replace(fit, correction=double[0], problem=double[1])
        return _derivative(fit, parts, reference, of_reference, tolerance)


def _double(x):
    return np.asarray(x, float) if eqx.is_inexact_array_like(x) and not isinstance(x, float) else x


def _derivative(
    fit: Fit, parts: Sequence[str], reference: Character | None, of_reference: bool, tolerance: float
) -> Change:
    held, problem = Held.of(fit, reference), fit.problem
    # central differences, at the step that balances their error with rounding
    step = float(jnp.finfo(float).eps) ** (1 / 3)
    body = _exact(reference if of_reference and reference is not None else problem.character)
    there = []
    for part in parts:
        grown = [grow(body, {part: 1.0 + way * step}) for way in WAYS]
        there.append([held.problem_on(reference=g) if of_reference else held.problem_on(g) for g in grown])
    blocks = [dataclasses.replace(s.block, max_steps=MAX_STEPS, tolerance=tolerance) for s in held.stages]
    points = refit(problem, blocks, correction=Correction(problem.controls, held.points)).correction.points
    points = tuple(jnp.asarray(p) for p in points)
    moves = [[np.zeros(p.shape) for p in points] for _ in parts]
    for block in blocks:
        solver = banded_solver(problem, block)
        assert solver is not None  # every term of limbs says its reach
        work = block_work(problem, block, points)
        for problems, move in zip(there, moves, strict=True):
            # what the blocks before it do counts too
            shifted = [tuple(jnp.asarray(p + way * step * m, float) for p, m in zip(points, move, strict=True))
                       for way in WAYS]  # fmt: skip
            ahead, behind = (_slope(block_work(p, block, some), work.start)
                             for p, some in zip(problems, shifted, strict=True))  # fmt: skip
            change = jax.tree.map(lambda a, b: (a - b) / (2 * step), ahead, behind)
            for at, moved in zip(work.free.tolist(), _answer(work, change, solver), strict=True):
                move[at] = np.asarray(moved, float)
    names = [c.name for c in problem.controls]
    counts = [len(fit.correction[name]) for name in names]
    return {part: {name: m[:count] for name, m, count in zip(names, move, counts, strict=True)}
            for part, move in zip(parts, moves, strict=True)}  # fmt: skip


def predict(fit: Fit, change: Change, girth: Mapping[str, float]) -> Correction:
    """The correction for a body a little different from the fit's, to first order: nothing is solved.

    `change` is what `girth_derivative` returned, `girth` the scales of the parts as in `motionfit.shape.grow`. For
    the new body's motion apply it to `motionfit.onto(fit.base, body.skeleton)`.
    """
    unknown = set(girth) - set(change)
    if unknown:
        raise InputError(f"no derivative for {', '.join(sorted(unknown))}; there are {', '.join(change)}")
    points = []
    for control, old in zip(fit.correction.controls, fit.correction.points, strict=True):
        steps = [(scale - 1.0) * change[part][control.name] for part, scale in girth.items()
                 if control.name in change[part]]  # fmt: skip
        points.append(jnp.asarray(old) + sum(steps))
    return Correction(fit.correction.controls, tuple(points))


class Held(NamedTuple):
    """A fit's problem with its choices held: a smooth function of its bodies."""

    problem: Problem
    reference: Character | None
    points: tuple[Float[np.ndarray, " _"], ...]  # of the problem's controls
    stages: tuple[Stage, ...]  # legs first: hands look at thighs, legs at no arms
    frames: int  # of the clip; the problem's repeat the last one up to a bucket's length
    alone: tuple[Bool[np.ndarray, " pairs"], ...]  # per stage, which pairs are left alone
    kept: tuple[Float[np.ndarray, "frames pairs"], ...]  # per stage, the depth [m] that may stay

    @classmethod
    def of(cls, fit: Fit, reference: Character | None) -> "Held":
        problem, frames = fit.problem, len(fit.details.get("frames", ()))
        kinds = {type(problem.terms.get(f"{name}_clearance")) for name in ("left_arm", "right_arm", "legs")}
        if not frames or not kinds & {SkinClearance, CapsuleClearance}:
            raise InputError("only a fit of arms or legs by the vertex or the capsule objective has a derivative with "
                             "respect to girth; give what motionfit.adapt or motionfit.adapt.limbs returned")  # fmt: skip
        recipes = tuple(name for name in LIMBS if any(f"{s}_clearance" in problem.terms for s in NAMES[name]))
        pairs = pairs_of(*recipes)
        nothing = np.zeros((frames, len(pairs)))
        stages = limb_stages(problem.character, recipes, pairs, "vertex" if SkinClearance in kinds else "capsule",
                             nothing, np.zeros(len(pairs), bool), nothing,
                             any(isinstance(t, TouchClearance) for t in problem.terms.values()))[::-1]  # fmt: skip
        points = tuple(_filled(fit.correction[c.name], c.basis.count) for c in problem.controls)
        held = cls(problem, reference, points, tuple(stages), frames, (), ())
        alone = tuple(held._alone(stage) for stage in stages)
        kept = (held._kept(s, a, problem.character, reference) for s, a in zip(stages, alone, strict=True))
        return held._replace(alone=alone, kept=tuple(kept))

    def problem_on(self, character: Character | None = None, reference: Character | None = None) -> Problem:
        """The problem on other bodies of the same topology; None stands for the fit's own."""
        problem, body = self.problem, character or self.problem.character
        terms = dict(problem.terms)
        filling = ((0, problem.motion.frame_count - self.frames), (0, 0))
        for stage, alone, kept in zip(self.stages, self.alone, self.kept, strict=True):
            name = f"{stage.block.name}_clearance"
            term = followed(self._term(stage), stage.clearance, problem.character, body)
            more = self._kept(stage, alone, body, reference or self.reference) - kept
            terms[name] = _allowing_more(term, np.pad(more, filling), stage.clearance)
        for name, term in problem.terms.items():
            if isinstance(term, TouchClearance):
                terms[name] = touching_on(self._touching(term, reference), body)
        return Problem(body, onto(problem.motion, body.skeleton), terms, problem.controls, problem.weights)

    def _touching(self, term: TouchClearance, reference: Character | None) -> TouchClearance:
        """The touches with what another reference shows in the frames that were looked at."""
        if reference is None or self.reference is None or not len(term.found):
            return term
        looks, at = np.unique(np.asarray(term.found)[..., 0], return_inverse=True)
        pairs = pairs_of(*(name for name in LIMBS if any(f"{s}_clearance" in self.problem.terms for s in NAMES[name])))
        clip = self.problem.motion[looks]
        before, after = (skin_depths(r, onto(clip, r.skeleton), pairs).depth for r in (self.reference, reference))
        place = at.reshape(term.found.shape[:2]), np.asarray(term.found)[..., 1]
        return eqx.tree_at(lambda t: t.allowed, term, np.asarray(term.allowed) + (after - before)[place])

    def _term(self, stage: Stage) -> Seen:
        term = self.problem.terms[f"{stage.block.name}_clearance"]
        assert isinstance(term, SkinClearance | CapsuleClearance)
        return term

    def _alone(self, stage: Stage) -> Bool[np.ndarray, " pairs"]:
        """The pairs of a stage that may keep what they show: the fit had nothing to take out there."""
        term = self._term(stage)
        allowed, owner = _allowed(term), np.concatenate(_owners(term, stage.clearance))
        before = volume_depths(stage.clearance, self.problem.motion[np.arange(self.frames)])
        first = [int(np.argmax(owner == k)) for k in range(len(stage.clearance.pairs))]
        return np.all(allowed[: self.frames, first] >= before - 1e-5, axis=0)

    def _kept(
        self, stage: Stage, alone: Bool[np.ndarray, " pairs"], character: Character, reference: Character | None
    ) -> Float[np.ndarray, "frames pairs"]:
        """Depth [m] that may stay before the rounds take anything off, as in `motionfit.adapt.limbs`."""
        clip, mine = self.problem.motion[np.arange(self.frames)], stage.clearance
        before = _depths(mine, self.problem.character, character, onto(clip, character.skeleton))
        if reference is None or self.reference is None:
            own = _depths(mine, self.problem.character, character, rest_motion(character.skeleton))
        else:
            objective = "vertex" if isinstance(mine.term, SkinClearance) else "capsule"
            theirs = build_clearance(self.reference, mine.pairs, objective)
            own = _depths(theirs, self.reference, reference, onto(clip, reference.skeleton))
        kept = own + ALLOWED_EXCESS
        return np.where(alone, np.maximum(before, own), kept)


def _depths(clearance: Clearance, old: Character, new: Character, motion: Motion):
    """Depth [m] of every pair on a body that a clearance follows to."""
    assert isinstance(clearance.term, SkinClearance | CapsuleClearance)
    term = followed(clearance.term, clearance, old, new)
    return volume_depths(clearance._replace(term=term), motion)


# --- a clearance on another body of the same topology -----------------------------------------------------------


def followed(term: Seen, whole: Clearance, old: Character, new: Character) -> Seen:
    """A clearance term with its volumes, or its probes and fields, as they are on a body of the same topology.

    `whole` is the clearance that the term was made of. The same vertices are probes and belong to the same segments.
    """
    if new is old:
        return term
    if isinstance(term, CapsuleClearance):
        return eqx.tree_at(lambda t: t.volumes, term, fit_volumes(new, "capsule", allocate_vertices(old)))
    probes = tuple(_followed_probes(p, old, new) for p in term.probes)
    fields = tuple(_followed_field(f, part, old, new)
                   for f, part in zip(term.fields, _parts_hit(whole), strict=True))  # fmt: skip
    return eqx.tree_at(lambda t: (t.probes, t.fields), term, (probes, fields))


def _followed_probes(probes: Probes, old: Character, new: Character) -> Probes:
    blend = np.asarray(probes.blend)
    weights, places = blend[:, 3:], blend[:, :3].sum(axis=0).T
    vertices = _vertex_tree(old).query(places)[1]
    moved = np.asarray(new.skin.vertices_bind, float)[vertices].T
    return Probes(probes.joints, np.concatenate([weights * moved, weights], axis=1))


def _followed_field(field: DepthField, part: str, old: Character, new: Character) -> DepthField:
    """The same grid, on which each depth goes with the distance to the skin; what is inside stays inside."""
    import igl

    surface, coefficients = part_surface(old, part), np.asarray(field.coefficients)
    axes = [np.asarray(field.origin)[a] + np.asarray(field.spacing)[a] * np.arange(coefficients.shape[a])
            for a in range(3)]  # fmt: skip
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    before, after = (
        np.sqrt(igl.point_mesh_squared_distance(nodes, standing_vertices(b)[surface.used], surface.triangles)[0])
        for b in (old, new)
    )
    depths = coefficients
    for axis in range(3):  # the splines' values at the nodes
        depths = correlate1d(depths, (0.125, 0.75, 0.125), axis, mode="mirror")
    depths = depths * (after / np.maximum(before, 1e-12)).reshape(depths.shape)
    positions, rotations = (x[0, np.asarray(field.joints)] for x in host_kinematics(standing(new.skeleton)))
    turns = Rotation.from_quat(rotations, scalar_first=True).as_matrix()
    return eqx.tree_at(lambda f: (f.coefficients, f.home_positions, f.home_rotations), field,
                       (spline_filter(depths, order=2), positions, turns))  # fmt: skip


def _field_of(whole: Clearance) -> tuple[int, ...]:
    assert isinstance(whole.term, SkinClearance)
    return whole.term.field_of


def _parts_hit(whole: Clearance) -> list[str]:
    """The part that each field of a clearance is of."""
    other, fields = {}, _field_of(whole)
    for part, pair, field in zip(whole.part_of_set, whole.pair_of_row, fields, strict=True):
        other[field] = next(p for p in whole.pairs[pair][:2] if p != part)
    return [other[k] for k in range(len(other))]


def _owners(term: Seen, whole: Clearance) -> list[Int[np.ndarray, " columns"]]:
    """Of which pair each column of a solver's term is, array by array of its `allowed`."""
    owner = np.array(whole.pair_of_row)
    if isinstance(term, CapsuleClearance):
        return [owner]
    sets = [[i for i, field in enumerate(_field_of(whole)) if field == k] for k in range(len(term.fields))]
    count = [SOLVE_PROBES[part.partition("_")[2]] for part in whole.part_of_set]
    return [np.repeat(owner[some], [count[i] for i in some]) for some in sets]


def _allowed(term: Seen) -> Float[np.ndarray, "frames columns"]:
    rows = (term.allowed,) if isinstance(term, CapsuleClearance) else term.allowed
    return np.concatenate([np.asarray(x, float) for x in rows], axis=1)


def _allowing_more(term: Seen, more: Float[np.ndarray, "frames pairs"], whole: Clearance) -> Seen:
    """The term with more depth [m] allowed."""
    owners = _owners(term, whole)
    rows = np.split(_allowed(term), np.cumsum([len(o) for o in owners])[:-1], axis=1)
    rows = tuple(x + more[:, owner] for x, owner in zip(rows, owners, strict=True))
    return eqx.tree_at(lambda t: t.allowed, term, rows[0] if isinstance(term, CapsuleClearance) else rows)


# --- the implicit function theorem ------------------------------------------------------------------------------


def _signals(work: Work, points: tuple[Array, ...]) -> Float[Array, "frames free"]:
    return jnp.stack([c.signal(p) for c, p in zip(work.controls, points, strict=True)], axis=1)


def _slope_in_signals(work: Work, signals: Float[Array, "frames free"]) -> Float[Array, "frames free"]:
    """dC/d signals of a block's cost. Frame t of a frame-local term depends on the signals of frame t alone, so that
    one product per control gives all of its frames: forward mode, whose derivative compiles many times faster."""
    objective = work.objective
    fixed = objective.signals(work.points)

    def costs(signals, local: bool) -> Float[Array, " frames"]:
        kin = objective.kinematics(fixed.at[:, jnp.asarray(work.free)].set(signals))
        total = jnp.zeros_like(signals[:, 0])
        for term, weight in zip(objective.terms, objective.weights, strict=True):
            if not isinstance(term, Energy) and (term.reach == 0) == local:
                total = total + 0.5 * weight * jnp.sum(jnp.square(term.residual(kin).reshape(len(total), -1)), axis=1)
        return total

    def product(seed):
        return jax.jvp(lambda s: costs(s, True), (signals,), (jnp.broadcast_to(seed, signals.shape),))[1]

    local = jax.vmap(product, out_axes=1)(jnp.eye(signals.shape[1], dtype=signals.dtype))
    return local + jax.grad(lambda s: jnp.sum(costs(s, False)))(signals)


@program
def _slope(work: Work, points: tuple[Array, ...]) -> tuple[Array, ...]:
    """dC/d points of a block's cost at some points of its controls."""
    signals, back = jax.vjp(lambda x: _signals(work, x), points)
    return back(_slope_in_signals(work, signals))[0]


@program
def _answer(work: Work, change: tuple[Array, ...], solver: Banded) -> tuple[Array, ...]:
    """How the optimum `work.start` answers a change of the slope there: -H^-1 change, H the Hessian of the cost."""
    signals, back = jax.vjp(lambda x: _signals(work, x), work.start)

    def product(move):
        moved = jax.jvp(lambda x: _signals(work, x), (work.start,), (move,))[1]
        return back(jax.jvp(lambda s: _slope_in_signals(work, s), (signals,), (moved,))[1])[0]

    hessian = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: work.start), lx.positive_semidefinite_tag)
    return jax.tree.map(jnp.negative, lx.linear_solve(hessian, change, solver, throw=False).value)


# --- arrays -----------------------------------------------------------------------------------------------------


def _vertex_tree(character: Character) -> KDTree:
    if "vertex tree" not in character.memo:
        character.memo["vertex tree"] = KDTree(np.asarray(character.skin.vertices_bind, float))
    return character.memo["vertex tree"]


def _exact(character: Character) -> Character:
    """With the skin in double precision, so that a small step is not rounded away."""
    return eqx.tree_at(lambda c: c.skin.vertices_bind, character, np.asarray(character.skin.vertices_bind, float))


def _filled(points, count: int) -> Float[np.ndarray, " count"]:
    return np.concatenate([np.asarray(points, float), np.zeros(count - len(points))])

"""General collisions, by groups that are data: thesis 4.6 and the arguments of appendix E's `removeCollision`.

The arm and leg blocks take out what a shape makes of a motion. What is left comes from the movement itself, for a
moment: a hand at the head, on the other arm, across the belly. And where a hand touches on purpose, it goes on touching.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from motionfit._character import PARTS, Character
from motionfit._control import Correction
from motionfit._fit import Fit, fit
from motionfit._motion import Motion, bind_pose, joint_angles
from motionfit._onto import onto
from motionfit._problem import During, Problem, Robust
from motionfit._skeleton import SIDES
from motionfit._solve import Block
from motionfit._types import InputError
from motionfit.adapt._clearance import Clearance, all_rows, counted_probes, kept_with, probe_depths, reduced, support
from motionfit.adapt._controls import Turn, turn_controls
from motionfit.adapt._limbs import jerk_scale, smooth_floor
from motionfit.adapt._limits import NEARLY, SkinLooks
from motionfit.adapt._record import put_down
from motionfit.adapt._sampling import Sampling, sampling
from motionfit.metrics import TOLERANCE, derivative_ratio, skin_gaps
from motionfit.shape.field import Probes, fit_field
from motionfit.shape.pairs import PAIRS, Pair
from motionfit.terms.penetration import SkinClearance, SkinContact
from motionfit.terms.pose import Effort, Smoothness

ALLOWED_EXCESS = 0.004  # [m] that may stay where more was
TOUCH = 0.02  # [m] from the surface: what counts as a touch on fields, and what a touch may come to
TOUCHED = 0.01  # [m] on the reference's skin, which knows better
TOUCH_AIM = 0.012  # [m] a touch is brought back to
HELD = 0.016  # [m] a solve is content with: where an arm then sinks in, a touch gives way a little
NEAR, EVERY = 0.06, 3  # [m] by the fields: where the skin is asked, in each third frame that is seen
EASE = 0.08  # [s] within which a touch is taken up and let go
EFFORT = 1.0  # [rad]
MOST_JERK = 1.04
ROUNDS, PATIENCE = 12, 3  # rounds at most, and without a better result
CLOSER = (0, 1, 2)  # rounds after which more frames are looked at
GIVES = (0.1, 0.2, 0.3, *(0.5,) * 5)  # of what sinks in, one after the other: a touch bears little of it
STIFFER = 4.0  # weight of what the skin shows, against the touches that pull the other way
PROBES = {"upper_arm": 20, "forearm": 16, "hand": 16}


class Sphere(NamedTuple):
    """A ball that must stay empty of other parts: at a joint's role, or at a skin `vertex` that moves with it.

    `offset` [m] is added in the bind pose, y up and z ahead; `radius` [m].
    """

    role: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.0
    vertex: int | None = None

    def place_bind(self, character: Character) -> Float[np.ndarray, "3"]:
        joint = character.skeleton.joint(self.role)
        if self.vertex is None:
            start = bind_pose(character.skeleton)[0][joint]
        else:
            start = np.asarray(character.skin.vertices_bind, float)[self.vertex]
        return start + np.asarray(self.offset)


class Group(NamedTuple):
    """What collides with what, and what may turn to avoid it.

    `probes` are parts, whose skin is looked at, or spheres; `avoid` are parts. `turns` are the controls, each of which
    may drive several joints by the same amount or its inverse. A knot every `spacing` frames that the solver sees (60
    per second). Groups with the same turns and spacing are solved together, so that none undoes the other.
    """

    name: str
    probes: tuple[str | Sphere, ...]
    avoid: tuple[str, ...]
    turns: tuple[Turn, ...]
    spacing: int = 2


def arm_turns(side: str) -> tuple[Turn, ...]:
    """Shoulder about all axes, elbow about its two useful ones."""
    arm, elbow = f"{side}_upper_arm", f"{side}_forearm"
    return (*(Turn(f"{arm}_{axis}", ((arm, axis, 1.0),), 1.0) for axis in ("left", "up", "forward")),
            Turn(f"{elbow}_bend", ((elbow, "bend", 1.0),), 1.0),
            Turn(f"{elbow}_swing", ((elbow, "swing", 1.0),), 0.35))  # fmt: skip


def _hands(side: str, other: str) -> tuple[Group, ...]:
    arm, hand = (f"{side}_forearm", f"{side}_hand"), f"{side}_hand"
    turns = (*arm_turns("left"), *arm_turns("right"))  # of both arms: each may touch the other
    return (
        Group(f"{hand}/torso", (f"{side}_upper_arm", *arm), ("torso",), turns),
        Group(f"{hand}/head", arm, ("head",), turns),
        Group(f"{hand}/shoulder", arm, (f"{other}_upper_arm", f"{other}_forearm", f"{other}_hand"), turns),
        Group(f"{hand}/legs", arm, tuple(f"{s}_thigh" for s in SIDES), turns),
    )


def _bent(side: str) -> Group:
    """The trunk straightens for a leg drawn up: it leaves the feet where they are."""
    turns = tuple(Turn(f"trunk_{axis}", (("chest", axis, 1.0),), np.pi / 8) for axis in ("left", "forward"))
    return Group(f"{side}_leg/torso", (f"{side}_calf",), ("torso",), turns)


GROUPS: tuple[Group, ...] = (*_hands("left", "right"), *_hands("right", "left"), *(_bent(s) for s in SIDES))
"""The five tables of the thesis, per side: legs/torso, hands/torso, hands/head, hands/shoulders, hands/legs."""


class Known(NamedTuple):
    """The clearance of some groups on a body, the radius [m] of each row, and which rows are those of a part's skin."""

    clearance: Clearance
    radius: Float[np.ndarray, " rows"]
    on_skin: Bool[np.ndarray, " rows"]

    def depths(self, motion: Motion) -> Float[np.ndarray, "frames rows"]:
        """Depth [m] of each row in each frame; negative where there is a gap."""
        return all_rows(self.clearance.term, motion) + self.radius


def collisions(
    clip: Motion, character: Character, so_far: Fit, *, reference: Character | None = None,
    groups: Sequence[Group] = GROUPS,
) -> Fit:  # fmt: skip
    """Take the groups' probes out of what they shall avoid, as far as they are deeper in than on `reference`.

    Where a hand touched on the reference (within 1 cm, on the skin), it is brought back to within 2 cm of the surface,
    as far as nothing sinks in for it. Without a reference, what the character shows with the clip before any correction
    may stay and touches, by the fields. What the arm and leg blocks reached is not undone: their pairs are in the
    tables, and with a reference what their skins show more becomes rows of the solve, as in `motionfit.adapt.limbs`.
    `details["collisions"]` holds per pair the greatest excess [m] before and after, and the share of the touched frames
    that still touch.
    """
    result, told = so_far, {}
    for some in _together(groups):
        result, more = _solve(clip, character, result, reference, some)
        told |= more
    return dataclasses.replace(result, details={**so_far.details, "collisions": told})


def _together(groups: Sequence[Group]) -> list[list[Group]]:
    found: dict[tuple, list[Group]] = {}
    for group in groups:
        found.setdefault((group.turns, group.spacing), []).append(group)
    return list(found.values())


def known_depths(character: Character, groups: Sequence[Group]) -> Known:
    pairs, probes, sets, set_of, parts, radius, on_skin = [], [], [], [], [], [], []
    for group in groups:
        for part in (p for p in (*group.avoid, *(q for q in group.probes if isinstance(q, str))) if p not in PARTS):
            raise InputError(f"group {group.name!r} names unknown part {part!r}; parts: {', '.join(PARTS)}")
        for probe in group.probes:
            for avoid in group.avoid:
                name = probe if isinstance(probe, str) else probe.role
                side = name.partition("_")[0] if name.startswith(SIDES) and avoid == "torso" else "left"
                # each hand is a set of its own: a touch by the other is no touch
                key = (avoid, side, name if name.endswith("hand") else name.partition("_")[0])
                if key not in sets:
                    sets.append(key)
                set_of.append(sets.index(key))
                pairs.append(Pair(name, avoid, group.name))
                parts.append(name)
                radius.append(0.0 if isinstance(probe, str) else probe.radius)
                on_skin.append(isinstance(probe, str))
                probes.append(kept_with(character, counted_probes, probe, avoid) if isinstance(probe, str)
                              else _at_sphere(character, probe))  # fmt: skip
    term = SkinClearance(tuple(probes), tuple(kept_with(character, fit_field, *key[:2]) for key in sets), tuple(set_of),
                         (np.zeros((1, 1)),) * len(probes))  # fmt: skip
    return Known(Clearance(term, tuple(pairs), tuple(range(len(pairs))), tuple(parts)), np.array(radius),
                 np.array(on_skin))  # fmt: skip


def _at_sphere(character: Character, sphere: Sphere) -> Probes:
    place = sphere.place_bind(character)
    return Probes(np.array([character.skeleton.joint(sphere.role)]), np.append(place, 1.0)[None, :, None])


def _solve(
    clip: Motion, character: Character, so_far: Fit, reference: Character | None, groups: list[Group]
) -> tuple[Fit, dict]:
    motion, known = so_far.motion, known_depths(character, groups)
    at = sampling(motion, groups[0].spacing / 60.0)
    small, count = at.motion(motion), len(at.frames)
    pairs, looks = known.clearance.pairs, skin_looks(clip, character, reference, at)
    if reference is None:
        own, touching = _shown(known, at.motion(so_far.base), None)
    else:
        own, touching = _shown(known_depths(reference, groups), at.motion(onto(clip, reference.skeleton)), reference)
    before = known.depths(small)
    # what meets at a joint goes no deeper than it is: on the skin, where that is looked at
    inner, limit = np.array([p.adjacent for p in pairs]), np.maximum(own, 0.0)
    most = np.where(inner, np.maximum(before, 0.0) + 0.001 if looks is None else np.inf, limit)
    allowed = np.where(inner, np.minimum(most, 1e3), limit + ALLOWED_EXCESS)

    def gaps(of: Motion, depths: np.ndarray) -> np.ndarray:
        return skin_gaps_near(character, of, pairs, -depths, touching & known.on_skin) if looks is not None else -depths

    gap_before = gaps(small, before)
    told = _told(pairs, before - limit, before - limit, gap_before, gap_before, touching)
    apart, worst = np.where(touching, gap_before - TOUCH, 0.0), np.where(inner, 0.0, before - limit)
    if max(worst.max(initial=0.0) - TOLERANCE, apart.max(initial=0.0)) <= 0.0:
        return so_far, told
    # in the frames around a touch the hand is on its way
    weight = gaussian_filter1d(maximum_filter1d(touching.astype(float), 3, axis=0), EASE / at.dt, axis=0)
    gap, off = np.full(own.shape, TOUCH_AIM), np.where(touching, gap_before + before, 0.0)

    controls = turn_controls(motion, at.whole, [t for t in groups[0].turns])
    points = Correction.zero(tuple(at.control(c) for c in controls))
    names, real = tuple(c.name for c in controls), np.arange(len(at.rows)) < count
    score = support(known.clearance, probe_depths(known.clearance, small), limit)
    seen = dataclasses.replace(motion[at.rows], dt=np.asarray(at.dt))
    smooth, history, on_skin = jerk_scale(motion), [], np.zeros((1, 1))
    tries = [(_faults(worst, apart, on_skin), so_far, before, points)]
    for round_ in range(ROUNDS):
        # what the fields are off by at a touch is taken off the wish
        clear, touch = _clear_and_touch(known, at, score, allowed, gap - off, weight)
        terms = {"collisions": clear, "touch": touch, "effort": During(Effort(EFFORT), real.astype(float)),
                 "smoothness": During(Smoothness(smooth), (np.arange(len(at.rows)) < count - 2).astype(float))}  # fmt: skip
        if looks is not None:
            terms["skin"] = looks.touch_term(np.arange(len(PAIRS)), ALLOWED_EXCESS, len(at.rows))
        problem = Problem(character, seen, terms, points.controls, {"skin": STIFFER} if looks is not None else None)
        solved = fit(problem, (Block("collisions", names, max_steps=24, tolerance=1e-3),), correction=points)
        points, history = solved.correction, [*history, *solved.history]
        result = on_top(so_far, Correction(controls, points.points), at)
        moved = at.motion(result.motion)
        after = known.depths(moved)
        gap_now = gaps(moved, after)
        over, apart = after - np.maximum(most, limit), np.where(touching, gap_now - HELD, 0.0)
        off = np.where(touching, gap_now + after, 0.0)
        if looks is not None:
            if round_ in CLOSER:
                tries = tries[:1]  # what was looked at in fewer frames cannot be compared
                looks.look_closer(joint_angles(moved, small).max(axis=1))
                may = np.maximum(looks.depths(small) - looks.own, NEARLY * TOLERANCE)
            on_skin = looks.depths_and_touches(moved) - looks.own - may
        jerk = derivative_ratio(result.motion, motion, 3) or 1.0
        if jerk <= MOST_JERK + 0.01:
            tries.append((_faults(over, apart, on_skin), result, after, points))
        done = max(over.max() - 0.7 * TOLERANCE, apart.max(), on_skin.max()) <= 0.0 and jerk <= MOST_JERK
        stale = len(tries) - 1 - int(np.argmin([t[0] for t in tries]))
        if done or stale >= PATIENCE:
            break
        if jerk > MOST_JERK:
            smooth *= 0.5
        allowed = allowed - np.where(over > 0.7 * TOLERANCE, np.minimum(over, 0.02), 0.0)
        gap = gap - np.where(apart > 0.0, np.minimum(apart + 0.003, 0.02), 0.0)
        score = np.maximum(score, support(known.clearance, probe_depths(known.clearance, moved), limit))
    # a touch that cannot be had without sinking in elsewhere is given up, and so is all that makes matters worse
    _, result, after, points = min(tries, key=lambda t: t[0])
    if result is not so_far:
        sunk = sinking_skin(looks, small, at)
        result = eased(so_far, Correction(controls, points.points), at, groups[0].spacing / 60.0, sunk)
        after = known.depths(at.motion(result.motion))
    told = _told(pairs, before - limit, after - limit, gap_before, gaps(at.motion(result.motion), after), touching)
    left = np.where(inner, 0.0, after - limit).max() > TOLERANCE
    return dataclasses.replace(result, history=(*so_far.history, *history),
                               status="violations_left" if left else so_far.status), told  # fmt: skip


def _shown(
    known: Known, motion: Motion, body: Character | None
) -> tuple[Float[np.ndarray, "frames rows"], Bool[np.ndarray, "frames rows"]]:
    """The depths [m] that a clip shows where it comes from, and where a hand touches there: on the skin of the `body`
    that it was made for, else on the fields."""
    own, pairs = known.depths(motion), known.clearance.pairs
    hands = np.array([p.first.endswith("hand") for p in pairs])
    if body is None:
        return own, hands & (own > -TOUCH)
    return own, hands & (skin_gaps_near(body, motion, pairs, -own, known.on_skin) < TOUCHED)


def _clear_and_touch(
    known: Known, at: Sampling, score: Float[np.ndarray, "sets points"], allowed: Float[np.ndarray, "frames rows"],
    gap: Float[np.ndarray, "frames rows"], weight: Float[np.ndarray, "frames rows"],
) -> tuple[SkinClearance, Robust]:  # fmt: skip
    """The rows that keep probes out, up to the depth [m] `allowed`, and those that keep a touch within a `gap` [m], as
    far as the `weight` says: one of each per field."""
    clear = reduced(known.clearance, score, filled(smooth_floor(allowed, at.dt) - known.radius, at, 1e3), PROBES)
    field_of = np.array(known.clearance.term.field_of)  # pyright: ignore[reportAttributeAccessIssue]
    by_set = [np.flatnonzero(field_of == k) for k in range(len(clear.fields))]
    near = np.stack([weight[:, rows].max(axis=1) for rows in by_set], axis=1)
    wish = np.stack([gap[:, rows].min(axis=1) for rows in by_set], axis=1)
    return clear, Robust(SkinContact(clear, filled(wish, at, 1e3), filled(near, at, 0.0)))


def skin_gaps_near(
    character: Character, motion: Motion, pairs: Sequence[Pair], by_field: Float[np.ndarray, "frames rows"],
    which: Bool[np.ndarray, "*frames rows"],
) -> Float[np.ndarray, "frames rows"]:  # fmt: skip
    """How far [m] the first parts are from the second: what the fields say, corrected by what the skin shows, of the
    rows `which`, in some of the frames in which they are near."""
    wanted = which & (by_field < NEAR)
    wanted[np.arange(len(wanted)) % EVERY != 0] = False
    shown, frames, result = skin_gaps(character, motion, pairs, wanted), np.arange(len(wanted)), by_field.copy()
    for k in np.flatnonzero(wanted.any(axis=0)):
        asked = np.flatnonzero(wanted[:, k])
        result[:, k] += np.interp(frames, asked, (shown - by_field)[asked, k])
    return result


def skin_looks(clip: Motion, character: Character, reference: Character | None, at: Sampling) -> SkinLooks | None:
    """Looks at the skin of arms and legs in the frames that are seen; None without a reference."""
    return None if reference is None else SkinLooks(clip[at.frames], character, reference, PAIRS)


def sinking_skin(looks: SkinLooks | None, small: Motion, at: Sampling) -> Callable[[Fit], Bool[np.ndarray, " seen"]]:
    """Says of a fit in which of the frames that are seen an arm or leg sinks in that was out in `small`: at a shoulder
    the fields, which controls are solved by, do not know the skin."""
    if looks is None:
        return lambda fit: np.zeros(small.frame_count, bool)
    most = np.maximum(looks.depths(small) - looks.own, NEARLY * TOLERANCE)

    def sunk(fit: Fit) -> Bool[np.ndarray, " seen"]:
        result = np.zeros(small.frame_count, bool)
        result[looks.at] = (looks.depths(at.motion(fit.motion)) - looks.own > most).any(axis=1)
        return result

    return sunk


def eased(
    so_far: Fit, mine: Correction, at: Sampling, spacing: float, sunk: Callable[[Fit], Bool[np.ndarray, " seen"]]
) -> Fit:
    """A fit with more controls on top, of knots every `spacing` [s], and less and less of them around the frames that
    show something `sunk`."""
    share, width = np.ones(at.basis.count), EASE / spacing
    for gives in GIVES:
        less = dataclasses.replace(mine, points=tuple(share * np.asarray(p)[: len(share)] for p in mine.points))
        result = on_top(so_far, less, at)
        where = sunk(result)
        jerk = derivative_ratio(result.motion, so_far.motion, 3) or 1.0
        if not where.any() and jerk <= MOST_JERK + 0.01:
            return result
        around = np.zeros(at.basis.count)
        around[np.asarray(at.basis.first)[np.flatnonzero(where)][:, None] + np.arange(4)] = 1.0
        around = gaussian_filter1d(maximum_filter1d(around, 2 * round(2 * width) + 1), width)
        share = share * (1.0 - gives * around) if where.any() else (1.0 - gives) * share
    return so_far


def _faults(
    over: Float[np.ndarray, "frames rows"], apart: Float[np.ndarray, "frames rows"],
    on_skin: Float[np.ndarray, "looks pairs"],
) -> float:  # fmt: skip
    """Share of the frames that show a violation, and of those that lost a touch: what a solve is judged by."""
    shown = (over > TOLERANCE).any(axis=1).mean() + (on_skin > 0.0).any(axis=1).mean()
    return 2.0 * float(shown) + float((apart > 0.0).mean(axis=0).sum())


def on_top(so_far: Fit, mine: Correction, at: Sampling) -> Fit:
    """More controls on top of a fit's motion: those joints whose turns add up with others' get what is missing."""
    mine = Correction(mine.controls, tuple(np.asarray(p)[: at.whole.count] for p in mine.points))
    motion = mine.apply(so_far.motion)
    both = Correction((*so_far.correction.controls, *mine.controls), (*so_far.correction.points, *mine.points))
    base = dataclasses.replace(so_far.base, root=so_far.motion.root)
    joints = sorted({int(d.joint) for c in mine.controls for d in c.drives})
    name = mine.controls[0].name
    return put_down(name, so_far, motion, base, both, joints)


def filled(rows: np.ndarray, at: Sampling, value: float) -> np.ndarray:
    return np.concatenate([rows, np.full((len(at.rows) - len(rows), rows.shape[1]), value)])


def _told(pairs, excess_before, excess_after, gap_before, gap_after, touching) -> dict:
    told = {}
    for k, pair in enumerate(pairs):
        row = {
            "excess_before_m": float(excess_before[:, k].max()),
            "excess_after_m": float(excess_after[:, k].max()),
        }
        if touching[:, k].any():
            row["touching_before"] = float((gap_before <= TOUCH)[touching[:, k], k].mean())
            row["touching_after"] = float((gap_after <= TOUCH)[touching[:, k], k].mean())
        told[pair.name] = row
    return told

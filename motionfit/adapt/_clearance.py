"""Which overlaps have to go: clearance terms for a character, with what the reference body shows allowed."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.special import expit

from motionfit._character import PARTS, Character
from motionfit._motion import Kinematics, Motion, forward_kinematics
from motionfit._programs import program
from motionfit._skeleton import SIDES
from motionfit._types import InputError
from motionfit.shape.field import fit_field, standing_vertices
from motionfit.shape.pairs import Pair
from motionfit.shape.probes import Probes, make_probes, sample_vertices
from motionfit.shape.surface import inside_depths, part_surface
from motionfit.shape.volumes import fit_volumes
from motionfit.terms.penetration import CapsuleClearance, JointClearance, SkinClearance

OBJECTIVES = ("vertex", "capsule", "joint")
PROBE_COUNT = 96  # per pair: one every 3 cm on an upper arm
Term = SkinClearance | CapsuleClearance | JointClearance


class Clearance(NamedTuple):
    """A clearance term that still allows nothing, and which of `pairs` each of its rows (or sets of probes) speaks of."""

    term: Term
    pairs: tuple[Pair, ...]
    pair_of_row: tuple[int, ...]
    part_of_set: tuple[str, ...] = ()  # whose skin the probes of a row are

    def allowing(self, allowed: Float[np.ndarray, "frames pairs"]) -> Term:
        """The term with a depth [m] per frame and pair that does not count."""
        rows = allowed[:, list(self.pair_of_row)]
        if isinstance(self.term, JointClearance):
            return eqx.tree_at(lambda t: t.min_distance, self.term, np.asarray(self.term.min_distance) - rows)
        if isinstance(self.term, SkinClearance):
            return eqx.tree_at(lambda t: t.allowed, self.term, tuple(rows[:, k, None] for k in range(rows.shape[1])))
        return eqx.tree_at(lambda t: t.allowed, self.term, rows)


def build_clearance(character: Character, pairs: tuple[Pair, ...], objective: str = "vertex") -> Clearance:
    """The clearance of some pairs of parts, by one of the three objectives.

    `vertex`: skin points of the first part against the depth field of the second, and for limbs of one kind the
    other way round too; `capsule`: the segments' capsules; `joint`: elbow to spine, thesis (4.6), and calf to calf
    on the frontal plane, (4.11). It is kept with the character, since it does not depend on the clip.
    """
    if objective not in OBJECTIVES:
        raise InputError(f"unknown objective {objective!r}; objectives: {', '.join(OBJECTIVES)}")
    key = ("clearance", pairs, objective)
    if key not in character.memo:
        builder = {"vertex": _vertex, "capsule": _capsule, "joint": _joint}[objective]
        character.memo[key] = builder(character, pairs)
    return character.memo[key]


def _vertex(character: Character, pairs: tuple[Pair, ...]) -> Clearance:
    # both directions for left against right: neither is the one that is hit
    directed = [(k, p.first, p.second) for k, p in enumerate(pairs)]
    directed += [(k, p.second, p.first) for k, p in enumerate(pairs) if _kind(p.first) == _kind(p.second)]
    directed.sort()
    # whose arm and thigh pull at a trunk depends on the side that comes near it
    met = [(b, a.partition("_")[0] if b == "torso" else "left") for _, a, b in directed]
    hit = list(dict.fromkeys(met))
    fields = tuple(kept_with(character, fit_field, *key) for key in hit)
    probes = tuple(kept_with(character, counted_probes, a, b) for _, a, b in directed)
    term = SkinClearance(probes, fields, tuple(hit.index(key) for key in met),
                         (np.zeros((1, 1)),) * len(directed))  # fmt: skip
    return Clearance(term, pairs, tuple(k for k, _, _ in directed), tuple(a for _, a, _ in directed))


def kept_with(character: Character, make, *parts: str):
    """`make(character, *parts)`, once per character."""
    key = (make.__name__, *parts)
    if key not in character.memo:
        character.memo[key] = make(character, *parts)
    return character.memo[key]


def counted_probes(character: Character, part: str, against: str):
    """Skin points of a part that lie outside the other part at bind: those inside are the joint itself.

    A third of them are the deepest ones with the arms hanging, where there are such: the fold of an armpit is small.
    """
    mine = np.flatnonzero(character.part_of_vertex == PARTS.index(part))
    surface = part_surface(character, against)

    def depths(vertices: np.ndarray) -> np.ndarray:
        return inside_depths(vertices[mine], vertices[surface.used], surface.triangles)

    outside = depths(np.asarray(character.skin.vertices_bind, float)) == 0.0
    if not outside.any():
        outside[:] = True
    hanging = np.where(outside, depths(standing_vertices(character)), 0.0)
    fold = np.argsort(-hanging)[: PROBE_COUNT // 3]
    fold = mine[fold[hanging[fold] > 0.0]]
    spread = sample_vertices(character, mine[outside], PROBE_COUNT - len(fold), apart_from=fold)
    return make_probes(character, part, np.concatenate([fold, spread]))


def _kind(part: str) -> str:
    return part.partition("_")[2] if part.startswith(SIDES) else part


def _roles_of(character: Character, part: str, available: tuple[str, ...]) -> list[str]:
    if part != "torso":
        return [part]
    return [r for r in available if r in ("hips", "chest") or r.startswith("spine_")]


def _capsule(character: Character, pairs: tuple[Pair, ...]) -> Clearance:
    volumes = fit_volumes(character, "capsule")
    rows = [
        (k, volumes.index(a), volumes.index(b))
        for k, pair in enumerate(pairs)
        for a in _roles_of(character, pair.first, volumes.roles)
        for b in _roles_of(character, pair.second, volumes.roles)
    ]
    owner, first, second = (tuple(column) for column in zip(*rows, strict=True))
    return Clearance(CapsuleClearance(volumes, first, second, np.zeros((1, len(rows)))), pairs, owner)


def _joint(character: Character, pairs: tuple[Pair, ...]) -> Clearance:
    """d_min is the sum of the radii of the two cylinders: thesis 4.2.3."""
    skeleton, volumes = character.skeleton, fit_volumes(character, "cylinder")
    spine = skeleton.chain("spine")
    trunk = skeleton.joint("chest") if len(spine) < 2 else spine[len(spine) // 2]
    radius = {role: float(np.mean(volumes.radii[k])) for k, role in enumerate(volumes.roles)}
    trunk_radius = max(radius[r] for r in _roles_of(character, "torso", volumes.roles))
    rows = []
    for k, pair in enumerate(pairs):
        side, _, kind = pair.first.partition("_")
        if pair.second == "torso" and kind == "upper_arm":
            rows.append((k, skeleton.joint(f"{side}_forearm"), trunk, trunk_radius + radius[f"{side}_forearm"], False))
        elif pair.block == "legs":
            joint = {"thigh": "calf", "calf": "foot"}[kind]
            rows.append((k, skeleton.joint(f"left_{joint}"), skeleton.joint(f"right_{joint}"),
                         radius[pair.first] + radius[pair.second], True))  # fmt: skip
    kept = sorted({k for k, *_ in rows})
    owner, first, second, limit, frontal = (tuple(column) for column in zip(*rows, strict=True))
    thighs = (skeleton.joint("left_thigh"), skeleton.joint("right_thigh")) if any(frontal) else None
    term = JointClearance(first, second, np.array([limit]), frontal=frontal, thighs=thighs)
    return Clearance(term, tuple(pairs[k] for k in kept), tuple(kept.index(k) for k in owner))


# --- looking at a motion ----------------------------------------------------------------------------------------

CHUNK = 64  # frames looked at at once: one program whatever the clip's length, and bounded memory
MANY = 2048  # frames of all probes that are scored at once: as fast as all, and bounded memory


def over_time(look, term: Term, motion: Motion) -> Float[np.ndarray, "frames ..."]:
    """`look(term, kinematics)` of chunk after chunk; the last frame is repeated to fill the last chunk."""
    frames = motion.frame_count
    order = np.minimum(np.arange(-(-frames // CHUNK) * CHUNK), frames - 1).reshape(-1, CHUNK)
    return np.concatenate([np.asarray(_look(look, term, motion[some])) for some in order])[:frames]


@program
def _look(look, term: Term, motion: Motion):
    return look(term, forward_kinematics(motion.skeleton, motion))


def all_rows(term: Term, motion: Motion) -> Float[np.ndarray, "frames rows"]:
    """Depth [m] of every row of a term in every frame; negative where there is a gap."""
    if isinstance(term, SkinClearance):
        return point_by_point(term, motion).max(axis=2).astype(float)
    return over_time(row_depths, term, motion).astype(float)


def row_depths(term: Term, kin: Kinematics) -> Float[Array, "frames rows"]:
    if isinstance(term, JointClearance):
        return jnp.asarray(term.min_distance) - term.distance(kin)
    return term.depth(kin)


def point_by_point(term: SkinClearance, motion: Motion) -> Float[np.ndarray, "frames sets points"]:
    """Depth [m] of every probe in every frame."""
    return over_time(_point_depths, term, motion)


def _point_depths(term: SkinClearance, kin: Kinematics) -> Float[Array, "frames sets points"]:
    depths = term.point_depths(kin)
    most = max(d.shape[1] for d in depths)
    # a set of fewer points repeats its last one
    return jnp.stack([jnp.pad(d, ((0, 0), (0, most - d.shape[1])), mode="edge") for d in depths], axis=1)


def probe_depths(clearance: Clearance, motion: Motion) -> Float[np.ndarray, "frames sets points"] | None:
    """Depth [m] of every probe in every frame; None where an objective has no probes."""
    return point_by_point(clearance.term, motion) if isinstance(clearance.term, SkinClearance) else None


def volume_depths(
    clearance: Clearance, motion: Motion, probes: Float[np.ndarray, "frames sets points"] | None = None
) -> Float[np.ndarray, "frames pairs"]:
    """Depth [m] of every pair in every frame on the volumes, 0 where they are apart. `probes` are the motion's
    `probe_depths`, where they are at hand."""
    rows = all_rows(clearance.term, motion) if probes is None else probes.max(axis=2).astype(float)
    owner = np.array(clearance.pair_of_row)
    depth = np.stack([rows[:, owner == k].max(axis=1) for k in range(len(clearance.pairs))], axis=1)
    return np.maximum(depth, 0.0)


def support(
    clearance: Clearance, depth: Float[np.ndarray, "frames sets points"] | None,
    allowed: Float[np.ndarray, "frames pairs"],
) -> Float[np.ndarray, "sets points"]:  # fmt: skip
    """How much each probe has to do with the depth of its pair over a clip, from its `probe_depths`: what `reduced`
    goes by.

    It is how often a point is within 5 mm of its set's deepest, where the set is near to showing too much.
    """
    if depth is None:
        return np.zeros((0, 0))
    score = np.zeros(depth.shape[1:])
    for start in range(0, len(depth), MANY):
        some, may = (x[start : start + MANY] for x in (depth, allowed))
        deepest = some.max(axis=2, keepdims=True)
        matters = expit((deepest - may[:, list(clearance.pair_of_row), None]) / 0.01)
        score += (matters * np.clip(1.0 + (some - deepest) / 0.005, 0.0, 1.0) + 1e-3 * some).sum(axis=0)
    return score


def reduced(
    clearance: Clearance, score: Float[np.ndarray, "sets points"], allowed: Float[np.ndarray, "frames pairs"],
    counts: Mapping[str, int],
) -> SkinClearance:  # fmt: skip
    """What the solver works with: of every set the probes of greatest score, one set per field.

    `counts` says how many by kind of part.
    """
    term, joined, rows = clearance.term, [], []
    for k in range(len(term.fields)):  # pyright: ignore[reportAttributeAccessIssue]
        sets = [i for i, owner in enumerate(term.field_of) if owner == k]  # pyright: ignore[reportAttributeAccessIssue]
        kept = []
        for i in sets:
            count = counts[_kind(clearance.part_of_set[i])]
            kept.append(np.sort(np.argsort(-score[i])[:count]))
        joined.append(Probes.joined([term.probes[i][some] for i, some in zip(sets, kept, strict=True)]))  # pyright: ignore[reportAttributeAccessIssue]
        columns = np.repeat([clearance.pair_of_row[i] for i in sets], [len(some) for some in kept])
        rows.append(allowed[:, columns])
    return SkinClearance(tuple(joined), term.fields, tuple(range(len(joined))), tuple(rows), term.sigma, term.width)  # pyright: ignore[reportAttributeAccessIssue]


def allowance(
    excess: Float[np.ndarray, "frames pairs"], tolerance: float, margin: float
) -> Float[np.ndarray, "frames pairs"]:
    """How much excess [m] over the reference a frame may keep.

    Up to `tolerance`, a frame is left alone; a frame that shows more is to end up `margin` below it. The step is
    taken linearly over one tolerance, so that the wish is continuous in the motion. The gap between the two
    makes adaptation idempotent: what was adapted once shows less than the tolerance and stays as it is.
    """
    share = np.clip((excess - tolerance) / max(tolerance, 1e-9), 0.0, 1.0)
    return tolerance - margin * share

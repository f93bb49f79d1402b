"""Which overlaps have to go: clearance terms for a character, with what the reference body shows allowed."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from motionfit._character import Character
from motionfit._motion import Kinematics, Motion, bind_pose, forward_kinematics, rest_motion
from motionfit._skeleton import SIDES, Skeleton
from motionfit._types import InputError
from motionfit.shape.pairs import Pair
from motionfit.shape.volumes import fit_section, fit_volumes, sample_probes
from motionfit.terms.penetration import CapsuleClearance, JointClearance, SkinClearance, bind_depths

OBJECTIVES = ("vertex", "capsule", "joint")
PROBE_COUNT = {"upper_arm": 48, "forearm": 48, "hand": 32, "thigh": 60, "calf": 32}
Term = SkinClearance | CapsuleClearance | JointClearance


class Clearance(NamedTuple):
    """A clearance term that still allows nothing, and which of `pairs` each of its rows speaks of."""

    term: Term
    pairs: tuple[Pair, ...]
    pair_of_row: tuple[int, ...]

    def row_depths(self, kin: Kinematics) -> Float[Array, "frames rows"]:
        if isinstance(self.term, JointClearance):
            return jnp.asarray(self.term.min_distance) - self.term.distance(kin)
        return self.term.depth(kin)

    def allowing(self, allowed: Float[np.ndarray, "frames rows"]) -> Term:
        """The term with a depth [m] per frame and row that does not count."""
        if isinstance(self.term, JointClearance):
            limit = np.asarray(self.term.min_distance) - allowed
            return eqx.tree_at(lambda t: t.min_distance, self.term, jnp.asarray(limit))
        return eqx.tree_at(lambda t: t.allowed, self.term, jnp.asarray(allowed))


def build_clearance(character: Character, pairs: tuple[Pair, ...], objective: str = "vertex") -> Clearance:
    """The clearance of some pairs of parts, by one of the three objectives.

    `vertex`: skin points of the first part against the generalised cylinder of the second, and for limbs of one
    kind the other way round too; `capsule`: the segments' capsules; `joint`: elbow to spine, thesis (4.6), and
    calf to calf on the frontal plane, (4.11).
    """
    if objective not in OBJECTIVES:
        raise InputError(f"unknown objective {objective!r}; objectives: {', '.join(OBJECTIVES)}")
    builder = {"vertex": _vertex, "capsule": _capsule, "joint": _joint}[objective]
    return builder(character, pairs)


def _vertex(character: Character, pairs: tuple[Pair, ...]) -> Clearance:
    # both directions for left against right: neither is the one that is hit
    directed = [(k, p.first, p.second) for k, p in enumerate(pairs)]
    directed += [(k, p.second, p.first) for k, p in enumerate(pairs) if _kind(p.first) == _kind(p.second)]
    directed.sort()
    probing = list(dict.fromkeys(a for _, a, _ in directed))
    hit = list(dict.fromkeys(b for _, _, b in directed))
    probes = tuple(sample_probes(character, part, PROBE_COUNT[_kind(part)]) for part in probing)
    sections = tuple(fit_section(character, part) for part in hit)
    indices = tuple((probing.index(a), hit.index(b)) for _, a, b in directed)
    counted = tuple((bind_depths(sections[s], probes[p].points_bind) <= 0.0).astype(float) for p, s in indices)
    frames_free = np.zeros((1, len(indices)))
    term = SkinClearance(probes, sections, indices, counted, frames_free)
    return Clearance(term, pairs, tuple(k for k, _, _ in directed))


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
    legs = all(p.block == "legs" for p in pairs)
    rows = []
    for k, pair in enumerate(pairs):
        side, _, kind = pair.first.partition("_")
        if pair.second == "torso" and kind == "upper_arm":
            rows.append((k, skeleton.joint(f"{side}_forearm"), trunk, trunk_radius + radius[f"{side}_forearm"]))
        elif kind in ("thigh", "calf") and legs:
            joint = {"thigh": "calf", "calf": "foot"}[kind]
            rows.append((k, skeleton.joint(f"left_{joint}"), skeleton.joint(f"right_{joint}"),
                         radius[pair.first] + radius[pair.second]))  # fmt: skip
    owner, first, second, limit = (tuple(column) for column in zip(*rows, strict=True))
    frontal = (skeleton.joint("left_thigh"), skeleton.joint("right_thigh")) if legs else None
    return Clearance(JointClearance(first, second, np.array([limit]), frontal=frontal), pairs, owner)


@eqx.filter_jit
def _row_depths(clearance: Clearance, motion: Motion) -> Float[Array, "frames rows"]:
    return clearance.row_depths(forward_kinematics(motion.skeleton, motion))


def volume_depths(clearance: Clearance, motion: Motion) -> Float[np.ndarray, "frames pairs"]:
    """Depth [m] of every pair in every frame on the volumes, 0 where they are apart."""
    rows = np.maximum(np.asarray(_row_depths(clearance, motion), float), 0.0)
    depth = np.zeros((len(rows), len(clearance.pairs)))
    for row, pair in enumerate(clearance.pair_of_row):
        depth[:, pair] = np.maximum(depth[:, pair], rows[:, row])
    return depth


def rest_depths(clearance: Clearance, character: Character) -> Float[np.ndarray, "1 pairs"]:
    """Depth [m] of every pair in the rest pose: what is allowed where there is no reference body."""
    return volume_depths(clearance, rest_motion(character.skeleton))


def standing(skeleton: Skeleton) -> Motion:
    """One frame of standing with the arms hanging 2 degrees from the vertical and straight, all else at bind."""
    rest = rest_motion(skeleton)
    positions, world = bind_pose(skeleton)
    rotations = np.array(rest.rotations, float)
    turned: dict[int, Rotation] = {}
    for side in SIDES:
        arm, elbow, hand = (skeleton.joint(f"{side}_{r}") for r in ("upper_arm", "forearm", "hand"))
        sign = np.sign(positions[arm][0] - positions[skeleton.joint("chest")][0])
        down = np.array([sign * np.sin(np.deg2rad(2)), -np.cos(np.deg2rad(2)), 0.0])
        for joint, end in ((arm, elbow), (elbow, hand)):
            bone = positions[end] - positions[joint]
            laid, _ = Rotation.align_vectors(down[None], (bone / np.linalg.norm(bone))[None])
            turned[joint] = laid * Rotation.from_quat(world[joint], scalar_first=True)
    for joint in sorted(turned):
        above, path = Rotation.identity(), []
        parent = skeleton.parents[joint]
        while parent >= 0 and parent not in turned:
            path.append(parent)
            parent = skeleton.parents[parent]
        above = turned[parent] if parent >= 0 else above
        for between in reversed(path):
            above = above * Rotation.from_quat(rotations[0, between], scalar_first=True)
        rotations[0, joint] = (above.inv() * turned[joint]).as_quat(scalar_first=True)
    return Motion(skeleton, rest.root, rotations, rest.dt)


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


__all__ = ["OBJECTIVES", "Clearance", "allowance", "build_clearance", "rest_depths", "volume_depths"]

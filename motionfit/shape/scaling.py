"""Skeleton and character in other lengths: thesis 4.9.2, 5.4 and figure 5.4.

Seven tailor's measures, each with a scale (1 keeps it, 2 doubles it). They overlap: waist to knee, inside leg and waist
height share the thigh; scye and back share nothing with them. Measures that are not given are free: of all segment
scales that meet the given ones the nearest to 1 are taken (least squares, weighted by length), so that one measure
alone scales its segments alike, and consistent measures are met exactly.
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy.spatial.transform import Rotation

from motionfit._character import Character
from motionfit._motion import Motion, bind_pose
from motionfit._skeleton import SIDES, Skeleton
from motionfit._skinning import Skin
from motionfit._types import InputError
from motionfit.shape.volumes import bone_tips

# Which segments a measure of figure 5.4 runs along. Lengths are from joint to joint: the waist is the lowest spine
# joint, the leg ends at the ankle (feet, hands and head keep their size), and the scye, the seat of the arm hole,
# is the clavicle bone from its root to the shoulder.
MEASURES: dict[str, tuple[str, ...]] = {
    "scye": ("clavicle",),
    "upper_arm": ("upper_arm",),
    "forearm": ("forearm",),
    "waist_knee": ("pelvis", "thigh"),
    "inside_leg": ("thigh", "calf"),
    "waist_height": ("pelvis", "thigh", "calf"),
    "back": ("spine",),
}
SEGMENTS: tuple[str, ...] = ("clavicle", "upper_arm", "forearm", "pelvis", "thigh", "calf", "spine")


def segment_scales(skeleton: Skeleton, measures: Mapping[str, float]) -> dict[str, float]:
    """The scale of each segment that meets the measures' scales."""
    for name, scale in measures.items():
        if name not in MEASURES:
            raise InputError(f"unknown measure {name!r}; measures: {', '.join(MEASURES)}")
        if not 0.1 <= scale <= 5.0:
            raise InputError(f"the scale of {name} is {scale:g}; scales from 0.1 to 5 are allowed")
        if name == "scye" and any(skeleton.find(f"{s}_clavicle") is None for s in SIDES):
            raise InputError("scye scales the clavicles, and this skeleton has none; leave it out, "
                             "or name them in a role mapping")  # fmt: skip
    length = _lengths(skeleton)
    wanted = np.array([(measures[m] - 1.0) * sum(length[s] for s in MEASURES[m]) for m in measures])
    share = np.array([[length[s] * (s in MEASURES[m]) for s in SEGMENTS] for m in measures]).reshape(-1, len(SEGMENTS))
    root = np.sqrt([max(length[s], 1e-9) for s in SEGMENTS])
    change = np.linalg.pinv(share / root, rcond=1e-6) @ wanted / root
    scales = dict(zip(SEGMENTS, 1.0 + change, strict=True))
    missed = [m for m, w, row in zip(measures, wanted, share, strict=True) if abs(row @ change - w) > 1e-6]
    wrong = [s for s in SEGMENTS if not 0.05 <= scales[s] <= 10.0]
    if missed or wrong:
        which = f"{missed[0]} cannot be met" if missed else f"the {wrong[0]} would be scaled by {scales[wrong[0]]:.2f}"
        raise InputError(f"measures {', '.join(f'{k}={v:g}' for k, v in measures.items())} contradict each other: "
                         f"{which}; leave one of them out")  # fmt: skip
    return scales


def _lengths(skeleton: Skeleton) -> dict[str, float]:
    """Length [m] of each segment, the mean of both sides."""
    positions = bind_pose(skeleton)[0]

    def between(a: int, b: int) -> float:
        return float(np.linalg.norm(positions[a] - positions[b]))

    bones = {"upper_arm": "forearm", "forearm": "hand", "thigh": "calf", "calf": "foot"}
    result = {
        kind: float(np.mean([between(skeleton.joint(f"{s}_{kind}"), skeleton.joint(f"{s}_{end}")) for s in SIDES]))
        for kind, end in bones.items()
    }
    clavicles = [(skeleton.find(f"{s}_clavicle"), skeleton.joint(f"{s}_upper_arm")) for s in SIDES]
    result["clavicle"] = float(np.mean([between(skeleton.parents[a] if c is None else c, a) for c, a in clavicles]))
    waist, neck = _spine_ends(skeleton)
    result["spine"] = between(waist, neck)
    thighs = np.mean([positions[skeleton.joint(f"{s}_thigh")][1] for s in SIDES])
    result["pelvis"] = float(max(positions[waist][1] - thighs, 0.0))
    return result


def _spine_ends(skeleton: Skeleton) -> tuple[int, int]:
    """The waist (lowest spine joint) and the nape (lowest neck joint, or the head)."""
    spine, neck = skeleton.chain("spine"), skeleton.chain("neck")
    return (spine[0] if spine else skeleton.joint("hips"), neck[0] if neck else skeleton.joint("head"))


class _Stretch(NamedTuple):
    """How what hangs on a joint is stretched, in the bind pose: along `axis` through joint `origin` by `scale`,
    between `low` and `high` [m] along it. What lies beyond goes with the end."""

    origin: int
    axis: np.ndarray
    scale: float
    low: float
    high: float

    def shift(self, offsets: np.ndarray) -> np.ndarray:
        """Displacement [m] of points at offsets [m] from the origin."""
        along = np.clip(offsets @ self.axis, self.low, self.high)
        return (self.scale - 1.0) * along[..., None] * self.axis


def _stretches(skeleton: Skeleton, scales: Mapping[str, float]) -> list[_Stretch]:
    positions, tips = bind_pose(skeleton)[0], bone_tips(skeleton)
    waist, neck = _spine_ends(skeleton)
    up = np.array([0.0, 1.0, 0.0])
    back = _unit(positions[neck] - positions[waist])
    result = []
    for joint in range(len(positions)):
        role = skeleton.nearest_role(joint) or "hips"
        kind = role.partition("_")[2] if role.startswith(SIDES) else role
        owner = joint if (found := skeleton.find(role)) is None else found
        if kind in ("clavicle", "upper_arm", "forearm", "thigh", "calf"):
            bone = tips[owner] - positions[owner]
            result.append(_Stretch(owner, _unit(bone), scales[kind], 0.0, float(np.linalg.norm(bone))))
        elif role == "hips":
            thighs = np.mean([positions[skeleton.joint(f"{s}_thigh")][1] for s in SIDES]) - positions[owner][1]
            above = positions[waist][1] - positions[owner][1]
            result.append(_Stretch(owner, up, scales["pelvis"], min(thighs, above, 0.0), max(thighs, above, 0.0)))
        elif kind == "chest" or role.startswith("spine_"):
            reach = (positions[neck] if kind == "chest" else tips[owner]) - positions[owner]
            result.append(_Stretch(owner, back, scales["spine"], 0.0, max(float(reach @ back), 0.0)))
        else:
            result.append(_Stretch(joint, up, 1.0, 0.0, 0.0))
    return result


def _unit(x: np.ndarray) -> np.ndarray:
    return x / max(float(np.linalg.norm(x)), 1e-12)


def _scaled_skeleton(skeleton: Skeleton, scales: Mapping[str, float]) -> tuple[Skeleton, list[_Stretch]]:
    """The skeleton with its bones stretched, feet on the same floor; and the stretch per joint."""
    positions, rotations = bind_pose(skeleton)
    stretch = _stretches(skeleton, scales)
    placed = positions.copy()
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            pull = stretch[parent]
            there, here = pull.shift(positions[[joint, parent]] - positions[pull.origin])
            placed[joint] = placed[parent] + positions[joint] - positions[parent] + there - here
    feet = [skeleton.joint(f"{s}_foot") for s in SIDES]
    placed[:, 1] += positions[feet, 1].mean() - placed[feet, 1].mean()
    offsets = np.array(skeleton.offsets, dtype=float)
    turns = [Rotation.from_quat(q, scalar_first=True) for q in rotations]
    for joint, parent in enumerate(skeleton.parents):
        moved = placed[joint] if parent < 0 else turns[parent].inv().apply(placed[joint] - placed[parent])
        # what does not move stays bit for bit
        same = np.allclose(placed[joint] - (placed[parent] if parent >= 0 else 0.0),
                           positions[joint] - (positions[parent] if parent >= 0 else 0.0), atol=1e-12)  # fmt: skip
        offsets[joint] = offsets[joint] if same else moved
    ends = np.array(skeleton.end_offsets, dtype=float)
    for k, parent in enumerate(skeleton.end_parents):
        pull, tip = stretch[parent], turns[parent].apply(ends[k])
        gap = positions[parent] - positions[pull.origin]
        if pull.scale != 1.0:
            ends[k] = turns[parent].inv().apply(tip + pull.shift(gap + tip) - pull.shift(gap))
    return eqx.tree_at(lambda s: (s.offsets, s.end_offsets), skeleton, (offsets, ends)), stretch


def scale_skeleton(character: Character, measures: Mapping[str, float]) -> Character:
    """The character with other bone lengths, the mesh following them: thesis 5.4.

    Each vertex is stretched along the bone of its joints, by its skin weights, so that limbs lengthen evenly. A scale
    of 1 for all measures returns the character itself. Put its clip on with `motionfit.onto` or `scale_root`.
    """
    scales = segment_scales(character.skeleton, measures)
    if all(abs(s - 1.0) < 1e-12 for s in scales.values()):
        return character
    skeleton, stretch = _scaled_skeleton(character.skeleton, scales)
    skin = character.skin
    vertices = np.asarray(skin.vertices_bind, float)
    joints, weights = np.asarray(skin.joints), np.asarray(skin.weights, float)
    old, new = bind_pose(character.skeleton)[0], bind_pose(skeleton)[0]
    moved = np.zeros_like(vertices)
    for joint, pull in enumerate(stretch):
        share = np.where(joints == joint, weights, 0.0).sum(axis=1)
        some = np.flatnonzero(share)
        shift = new[pull.origin] - old[pull.origin] + pull.shift(vertices[some] - old[pull.origin])
        moved[some] += share[some, None] * shift
    scaled = Skin((vertices + moved).astype(skin.vertices_bind.dtype), skin.faces, skin.joints, skin.weights)
    return Character(skeleton, scaled, _named(character, measures))


def scale_character(character: Character, measures: Mapping[str, float]) -> Character:
    """Other bone lengths under the mesh as it is, which is attached anew: thesis 5.4.

    For a character whose mesh was deformed beforehand: the measures say how its skeleton has to follow.
    """
    scales = segment_scales(character.skeleton, measures)
    if all(abs(s - 1.0) < 1e-12 for s in scales.values()):
        return character
    return Character(_scaled_skeleton(character.skeleton, scales)[0], character.skin, _named(character, measures))


def scale_root(motion: Motion, skeleton: Skeleton) -> Motion:
    """The motion on a scaled skeleton of its own: root path scaled with the legs, thesis 5.4.

    The rotations stay bit for bit. Horizontally the path is scaled with hip joint to ankle; the height so that the
    ankles stay where they were in a standing pose. (`motionfit.onto` does the like between skeletons of any kind.)
    """
    if motion.skeleton.names != skeleton.names:
        raise InputError("scale_root needs the motion's own skeleton in other lengths; "
                         "between different skeletons use motionfit.onto(motion, skeleton)")  # fmt: skip
    old, new = bind_pose(motion.skeleton)[0], bind_pose(skeleton)[0]
    feet = [skeleton.joint(f"{s}_foot") for s in SIDES]
    legs = [_lengths(s)["thigh"] + _lengths(s)["calf"] for s in (motion.skeleton, skeleton)]
    root = np.array(motion.root, dtype=float)
    ankle = [p[feet, 1].mean() for p in (old, new)]
    height = (new[0, 1] - ankle[1]) / max(old[0, 1] - ankle[0], 1e-9)
    scaled = root * np.array([legs[1] / legs[0], 0.0, legs[1] / legs[0]])
    scaled[:, 1] = ankle[1] + (root[:, 1] - ankle[0]) * height
    return Motion(skeleton, scaled, motion.rotations, motion.dt)


def _named(character: Character, measures: Mapping[str, float]) -> str:
    return f"{character.name} ({', '.join(f'{k}={v:g}' for k, v in measures.items())})"

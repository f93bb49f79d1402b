"""Girth: grow parts of a character, thesis (4.21), and move its joints with it, 4.9.2."""

import re
from collections.abc import Mapping

import equinox as eqx
import numpy as np
from scipy.sparse import coo_array, csr_array

from motionfit._character import PART_OF_ROLE, Character
from motionfit._motion import bind_pose
from motionfit._skeleton import SIDES, Skeleton
from motionfit._skinning import Skin
from motionfit._types import InputError
from motionfit.shape.volumes import bone_tips

PARTS: dict[str, tuple[str, ...]] = {
    **{f"{s}_arm": (f"{s}_upper_arm", f"{s}_forearm") for s in SIDES},
    **{f"{s}_leg": (f"{s}_thigh", f"{s}_calf") for s in SIDES},
}
PARTS["arms"] = (*PARTS["left_arm"], *PARTS["right_arm"])
PARTS["legs"] = (*PARTS["left_leg"], *PARTS["right_leg"])


def parse_girth(text: str) -> dict[str, float]:
    """`arms=1.3,trunk=1.5`, or one number for arms, legs and trunk together, to {part: scale}."""
    girth: dict[str, float] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        match = re.fullmatch(r"(?:([a-z_0-9]+)=)?([0-9.eE+-]+)", item)
        try:
            assert match is not None
            scale = float(match[2])
        except (AssertionError, ValueError):
            raise InputError(f"girth {item!r} is not PART=SCALE; write for example arms=1.3,trunk=1.5") from None
        girth |= {match[1]: scale} if match[1] else dict.fromkeys(("arms", "legs", "trunk"), scale)
    if not girth:
        raise InputError("girth is empty; write for example arms=1.3,trunk=1.5")
    return girth


def grow(character: Character, girth: Mapping[str, float]) -> Character:
    """The character with parts thicker (scale above 1) or thinner, across their bones.

    `girth` maps parts (arms, legs, trunk, left_arm, right_arm, left_leg, right_leg, or a bone's role) to scales.
    Each vertex keeps its offset along the bone and has it scaled across, by 1 + (scale - 1) W', where W' is the
    sum of its weights on the grown bones averaged over its one-ring: (4.21). A trunk scale also scales the
    offsets of the clavicles, upper arms and thighs, so that the limbs stay outside: 4.9.2. A scale of 1 returns
    every array bit for bit.
    """
    skeleton, skin = character.skeleton, character.skin
    for part, scale in girth.items():
        if not 0.1 <= scale <= 5.0:
            raise InputError(f"girth of {part} is {scale:g}; scales from 0.1 to 5 are allowed")
    scale_of_joint = _scale_per_joint(skeleton, girth)
    if all(scale == 1.0 for scale in girth.values()):
        return character

    vertices = np.asarray(skin.vertices_bind, float)
    joints, weights = np.asarray(skin.joints), np.asarray(skin.weights, float)
    positions = bind_pose(skeleton)[0]
    grown = _grown_skeleton(skeleton, girth.get("trunk", 1.0))
    new_positions = bind_pose(grown)[0]
    axes = _growth_axes(skeleton, positions)
    ring = _one_ring_mean(np.asarray(skin.faces), len(vertices))

    moved = np.zeros_like(vertices)
    # parts of one scale are one limb: W sums over all of its bones, so nothing thins out at an elbow
    for scale in sorted(set(scale_of_joint[scale_of_joint != 1.0])):
        limb = np.flatnonzero(scale_of_joint == scale)
        total = np.where(np.isin(joints, limb), weights, 0.0).sum(-1)
        smooth = ring @ total
        for joint in limb:
            share = np.where(joints == joint, weights, 0.0).sum(-1) / np.maximum(total, 1e-9)
            offset = vertices - positions[joint]
            across = offset - (offset @ axes[joint])[:, None] * axes[joint]
            # a vertex between several grown bones takes the mean of their growths, by its weights
            moved += ((scale - 1.0) * smooth * share)[:, None] * across
    shift = new_positions - positions
    moved += np.einsum("vk,vka->va", weights, shift[joints])
    new_skin = Skin((vertices + moved).astype(skin.vertices_bind.dtype), skin.faces, skin.joints, skin.weights)
    name = f"{character.name} ({', '.join(f'{k}={v:g}' for k, v in girth.items())})"
    return Character(grown, new_skin, name)


def _scale_per_joint(skeleton: Skeleton, girth: Mapping[str, float]) -> np.ndarray:
    scales = np.ones(len(skeleton.names))
    trunk = {"hips", "chest", "left_clavicle", "right_clavicle"}
    trunk |= {r for r, _ in skeleton.roles if r.startswith("spine_")}
    for part, scale in girth.items():
        roles = trunk if part == "trunk" else PARTS.get(part, (part,))
        if part not in PARTS and part != "trunk" and skeleton.find(part) is None:
            known = ["arms", "legs", "trunk", *(p for p in PARTS if p not in ("arms", "legs"))]
            raise InputError(f"unknown part {part!r}; parts: {', '.join(known)}, "
                             f"or a role: {', '.join(r for r, _ in skeleton.roles)}")  # fmt: skip
        for joint in range(len(scales)):
            if skeleton.nearest_role(joint) in roles:
                scales[joint] *= scale
    return scales


def _grown_skeleton(skeleton: Skeleton, trunk: float) -> Skeleton:
    """Clavicle, upper-arm and thigh offsets scaled with the trunk (4.9.2, figure 4.19)."""
    offsets = np.array(skeleton.offsets, copy=True)
    for side in SIDES:
        for role in ("clavicle", "upper_arm", "thigh"):
            if (joint := skeleton.find(f"{side}_{role}")) is not None:
                offsets[joint] = offsets[joint] * trunk
    return eqx.tree_at(lambda s: s.offsets, skeleton, offsets)


def _growth_axes(skeleton: Skeleton, positions: np.ndarray) -> np.ndarray:
    """The direction along which each joint's skin keeps its place: that of the limb's bone, and for everything
    on the trunk, clavicles and hip helpers included, that of the spine."""
    tips = bone_tips(skeleton)
    spine = positions[skeleton.joint("chest")] - positions[skeleton.joint("hips")]
    axes = np.tile(_unit(spine), (len(positions), 1))
    for joint in range(len(positions)):
        role = skeleton.nearest_role(joint) or "hips"
        if role in PART_OF_ROLE and PART_OF_ROLE[role] not in ("torso", "head"):
            owner = skeleton.joint(role)
            axes[joint] = _unit(tips[owner] - positions[owner])
    return axes


def _one_ring_mean(faces: np.ndarray, count: int) -> csr_array:
    """The matrix that averages a value over each vertex and the vertices connected to it."""
    rows = np.concatenate([faces[:, i] for i in (0, 1, 2, 0, 1, 2)])
    columns = np.concatenate([faces[:, i] for i in (1, 2, 0, 2, 0, 1)])
    pairs = np.unique(np.stack([np.append(rows, np.arange(count)), np.append(columns, np.arange(count))]), axis=1)
    degree = np.bincount(pairs[0], minlength=count)
    return coo_array((1.0 / degree[pairs[0]], (pairs[0], pairs[1])), shape=(count, count)).tocsr()


def _unit(x: np.ndarray) -> np.ndarray:
    return x / max(float(np.linalg.norm(x)), 1e-12)

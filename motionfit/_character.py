"""A character: a skeleton with a skin. Its invariants are checked here, once."""

import hashlib

import equinox as eqx
import numpy as np
from jaxtyping import Int

from motionfit._remembered import Remembering, remembered
from motionfit._skeleton import SIDES, Skeleton
from motionfit._skinning import Skin
from motionfit._types import InputError

# The body parts whose surfaces are tested against each other, and the roles of the joints that carry them.
# Joints without a role (twist bones, fingers, hip helpers) belong to the part of the joint that carries them.
PART_OF_ROLE = {"hips": "torso", "chest": "torso", "head": "head"}
for _side in SIDES:
    PART_OF_ROLE |= {f"{_side}_{r}": f"{_side}_{r}" for r in ("upper_arm", "forearm", "hand", "thigh", "calf", "foot")}
    PART_OF_ROLE |= {f"{_side}_clavicle": "torso", f"{_side}_toe": f"{_side}_foot"}
PARTS = tuple(dict.fromkeys(PART_OF_ROLE.values()))


def part_of_joint(skeleton: Skeleton, joint: int) -> str:
    """The body part that a joint's skin belongs to."""
    role = skeleton.nearest_role(joint)
    if role is None:
        return "torso"
    if role.startswith("spine_"):
        return "torso"
    return "head" if role.startswith("neck_") else PART_OF_ROLE[role]


class Character(eqx.Module, Remembering):
    """Skeleton + Skin, with the roles that the adaptation needs.

    `name` is what reports call it. Body volumes are fitted to it by `motionfit.shape`.
    """

    skeleton: Skeleton
    skin: Skin
    name: str = eqx.field(static=True, default="character")

    def __check_init__(self):
        joints = len(self.skeleton.names)
        if isinstance(self.skin.joints, np.ndarray):
            used = self.skin.joints[np.asarray(self.skin.weights) > 0]
            if used.size and (used.min() < 0 or used.max() >= joints):
                raise InputError(f"{self.name}: the skin names joint {int(used.max())}, but there are {joints}")

    @remembered
    def memo(self) -> dict:
        """What was fitted once to this very character on the host."""
        return {}

    @remembered
    def fingerprint(self) -> str:
        """Tells bodies apart by their skin in the bind pose, in single precision, as files hold it."""
        return hashlib.sha256(np.asarray(self.skin.vertices_bind, np.float32).tobytes()).hexdigest()[:16]

    @remembered
    def part_of_vertex(self) -> Int[np.ndarray, " vertices"]:
        """Index into `PARTS` of each vertex, by its joint of greatest weight."""
        of_joint = np.array([PARTS.index(part_of_joint(self.skeleton, j)) for j in range(len(self.skeleton.names))])
        return of_joint[self.skin.main_joint]

"""Probes: points of a part's own skin that are tested against other parts' depth fields."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from motionfit._character import Character
from motionfit._motion import Kinematics
from motionfit._skeleton import SIDES, Skeleton
from motionfit._types import AnyArray


class Probes(eqx.Module):
    """Points of a part's own skin.

    `blend` holds skin weight times bind-pose position, so that posing all of them, (4.20), is one matrix product
    with the transforms of the few `joints` that carry the part.
    """

    joints: Int[AnyArray, " carrying"]
    blend: Float[AnyArray, "carrying 4 points"]

    def positions_world(self, kin: Kinematics) -> Float[Array, "frames 3 points"]:
        """World positions [m]."""
        turns, shifts = kin.skin_transforms(jnp.asarray(self.joints))
        moves = jnp.concatenate([turns, shifts[..., None]], axis=-1)
        blend = jnp.asarray(self.blend, moves.dtype)
        frames, carrying = moves.shape[:2]
        rows = jnp.moveaxis(moves, 2, 1).reshape(3 * frames, carrying * 4)
        return (rows @ blend.reshape(carrying * 4, -1)).reshape(frames, 3, -1)

    def __getitem__(self, points: np.ndarray) -> "Probes":
        return Probes(self.joints, self.blend[..., points])

    @classmethod
    def joined(cls, some: Sequence["Probes"]) -> "Probes":
        """Several as one, on the joints of all of them."""
        joints = sorted(set(np.concatenate([p.joints for p in some]).tolist()))
        blend = np.zeros((len(joints), 4, sum(p.blend.shape[2] for p in some)))
        start = 0
        for p in some:
            stop = start + p.blend.shape[2]
            blend[[joints.index(j) for j in p.joints.tolist()], :, start:stop] = p.blend
            start = stop
        return cls(np.array(joints), blend)


class ProbeSets(eqx.Module):
    """Sets of as many probes each; `joints` and `blend` are those of `Probes`, set after set."""

    joints: Int[AnyArray, "sets carrying"]
    blend: Float[AnyArray, "sets carrying 4 points"]

    @classmethod
    def of(cls, some: Sequence[Probes]) -> "ProbeSets":
        """A set on fewer joints repeats its last one, which moves nothing."""
        most = max(len(p.joints) for p in some)
        short = [most - len(p.joints) for p in some]
        joints = [np.pad(p.joints, (0, n), "edge") for p, n in zip(some, short, strict=True)]
        return cls(np.stack(joints), np.stack([np.pad(p.blend, ((0, n), (0, 0), (0, 0))) for p, n in
                                               zip(some, short, strict=True)]))  # fmt: skip

    def positions_world(
        self, kin: Kinematics, frame: Int[Array, " meetings"], met: Int[Array, " meetings"]
    ) -> Float[Array, "meetings 3 points"]:
        """World positions [m] of some sets, each in a frame of its own."""
        turns, shifts = kin.skin_transforms()
        moves = jnp.concatenate([turns, shifts[..., None]], axis=-1)[frame[:, None], jnp.asarray(self.joints)[met]]
        return jnp.einsum("tcab,tcbp->tap", moves, jnp.asarray(self.blend, moves.dtype)[met])


def sample_vertices(
    character: Character, among: Int[np.ndarray, " some"], count: int, apart_from: Int[np.ndarray, " known"]
) -> Int[np.ndarray, " count"]:
    """`count` vertices by farthest-point sampling, `apart_from` others; the last is repeated where there are fewer, so
    that every body has the same number."""
    points, known = np.asarray(character.skin.vertices_bind, float)[among], list(apart_from)
    distance = np.full(len(points), np.inf)
    for vertex in known:
        distance = np.minimum(
            distance, ((points - np.asarray(character.skin.vertices_bind, float)[vertex]) ** 2).sum(-1)
        )
    chosen = [int(distance.argmax()) if known else int(np.argmin(points @ np.array([0.3, 1.0, 0.2])))]
    for _ in range(min(count, len(points)) - 1):
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(-1))
        chosen.append(int(distance.argmax()))
    return among[chosen + [chosen[-1]] * (count - len(chosen))]


def make_probes(character: Character, part: str, vertices: Int[np.ndarray, " points"]) -> Probes:
    """Probes at some vertices of a part."""
    skin, carrying = character.skin, carrying_joints(character.skeleton, part)
    joints, shares = np.asarray(skin.joints)[vertices], np.asarray(skin.weights, float)[vertices]
    weights = np.stack([np.where(joints == j, shares, 0.0).sum(-1) for j in carrying])
    weights /= np.maximum(weights.sum(0), 1e-9)
    points = np.asarray(skin.vertices_bind, float)[vertices]
    homogeneous = np.concatenate([points.T, np.ones((1, len(vertices)))])
    return Probes(np.array(carrying), weights[:, None] * homogeneous[None])


def carrying_joints(skeleton: Skeleton, part: str) -> tuple[int, ...]:
    """The joints that carry a part's probes: its own, and those of the limbs next to it.

    Weights of joints further away are left out, so a vertex in the fold of an armpit, which hangs on the spine too,
    goes with the arm by a centimetre more than on the skin. That errs towards the trunk, where the fields know least:
    with all weights kept, the fields lose sight of the fold on bodies whose arms and trunk are 1.6 times as thick.
    """
    side, _, kind = part.partition("_")
    around = {
        "upper_arm": ("chest", f"{side}_clavicle", f"{side}_forearm"),
        "forearm": (f"{side}_upper_arm", f"{side}_hand"),
        "hand": (f"{side}_forearm",),
        "thigh": ("hips", f"{side}_calf", *(f"{s}_thigh" for s in SIDES if s != side)),
        "calf": (f"{side}_thigh", f"{side}_foot"),
        "foot": (f"{side}_calf", f"{side}_toe"),
    }.get(kind, ())
    roles = {part, *around}
    return tuple(j for j in range(len(skeleton.names)) if skeleton.nearest_role(j) in roles)

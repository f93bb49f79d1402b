"""A motion over time, and the kinematics that everything else reads."""

from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation, Slerp

from motionfit import rotation
from motionfit._skeleton import Skeleton
from motionfit._types import AnyArray, InputError, Positions, Rotations


class Motion(eqx.Module):
    """A clip: where the root is and how each joint is turned, frame by frame, on the skeleton it was made for.

    `root` [m] is the root joint's position in the world; `rotations` are joint-to-parent unit quaternions wxyz;
    `dt` [s] the time between frames. `translations` [m] are joint-to-parent positions for the rare file that
    animates them (None: the skeleton's offsets hold). An adapted clip remembers its `source`; what is cut from it or
    moved further does not.
    """

    skeleton: Skeleton
    root: Float[AnyArray, "frames 3"]
    rotations: Rotations
    dt: Float[AnyArray, ""] = eqx.field(converter=lambda x: np.asarray(x, float) if isinstance(x, float | int) else x)
    translations: Positions | None = None
    source: "Source | None" = None

    def __check_init__(self):
        joints = len(self.skeleton.names)
        root, rotations = getattr(self.root, "shape", None), getattr(self.rotations, "shape", None)
        if root is not None and rotations is not None and rotations[-3:] != (*root[-2:-1], joints, 4):
            raise InputError(f"a motion of {joints} joints needs root (frames, 3) and rotations (frames, {joints}, 4); "
                             f"got {root} and {rotations}")  # fmt: skip

    @property
    def frame_count(self) -> int:
        return self.root.shape[0]

    @property
    def frame_rate(self) -> float:
        """[1/s]"""
        return 1.0 / float(self.dt)

    def __getitem__(self, frames: slice | np.ndarray) -> "Motion":
        """The motion of some frames, at the same dt."""
        translations = None if self.translations is None else self.translations[frames]
        return Motion(self.skeleton, self.root[frames], self.rotations[frames], self.dt, translations)

    def source_on(self, body: str) -> "Motion":
        """The clip that this one was adapted from, if that was to the same body (`Character.fingerprint`); else itself.

        What a reference body shows has to be measured with it. The adapted clip leads the arms out, on the reference
        too: there it shows less overlap than its source, and the little that may stay would pass for a violation.
        """
        return self.source.motion if self.source is not None and self.source.body == body else self


class Source(eqx.Module):
    """What an adapted clip was made from: the clip, frame by frame, and the fingerprint of the body it was made for."""

    motion: Motion
    body: str = eqx.field(static=True)


def rest_motion(skeleton: Skeleton, dt: float = 1 / 60) -> Motion:
    """One frame in the bind pose."""
    return Motion(skeleton, skeleton.offsets[:1], skeleton.rest_rotations[None], dt)


def bucket(frame_count: int) -> int:
    """The least of 16, 24, 32, 48, 64, 96, ... that is not below: clips of one bucket share a compiled program."""
    size = 16
    while size < frame_count:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


def padded(motion: Motion, frame_count: int) -> Motion:
    """The motion with its last frame repeated up to `frame_count` frames."""
    return motion[np.minimum(np.arange(frame_count), motion.frame_count - 1)]


def continued(motion: Motion, frame_count: int) -> Motion:
    """The motion going on past its end, turned half round about its last frame (an odd reflection): positions and
    rotations go on at the speed they have there, so that filters near the end see no stop."""
    frames, last = np.arange(frame_count), motion.frame_count - 1
    mirror = np.clip(np.where(frames > last, 2 * last - frames, frames), 0, last)
    beyond = frames > last
    root, rotations = np.asarray(motion.root, float)[mirror], np.asarray(motion.rotations, float)[mirror]
    root[beyond] = 2 * root[last] - root[beyond]
    end = Rotation.from_quat(rotations[last], scalar_first=True)
    for joint in range(rotations.shape[1]):
        back = Rotation.from_quat(rotations[beyond, joint], scalar_first=True)
        rotations[beyond, joint] = (end[joint] * back.inv() * end[joint]).as_quat(scalar_first=True)
    translations = None if motion.translations is None else motion.translations[mirror]
    return Motion(motion.skeleton, root, rotations, motion.dt, translations)


def resample(motion: Motion, frame_rate: float) -> Motion:
    """The clip at another frame rate [1/s]: positions linearly, rotations along the shortest arc (SciPy Slerp)."""
    if frame_rate <= 0:
        raise InputError(f"a frame rate must be above 0, got {frame_rate}")
    times = np.arange(motion.frame_count) * float(motion.dt)
    # the small allowance keeps the last frame when the duration is a whole number of new frames
    new = np.arange(int(times[-1] * frame_rate + 1e-6) + 1) / frame_rate
    if motion.frame_count == 1 or (len(new) == len(times) and np.allclose(new, times, atol=1e-9)):
        return motion
    new = np.minimum(new, times[-1])
    rotations = np.asarray(motion.rotations)
    turned = np.stack(
        [
            Slerp(times, Rotation.from_quat(rotations[:, j], scalar_first=True))(new).as_quat(scalar_first=True)
            for j in range(rotations.shape[1])
        ],
        axis=1,
    )

    def linear(x):
        x = np.asarray(x)
        columns = [np.interp(new, times, c) for c in x.reshape(len(times), -1).T]
        return np.stack(columns, axis=1).reshape(len(new), *x.shape[1:])

    translations = None if motion.translations is None else linear(motion.translations)
    return Motion(motion.skeleton, linear(motion.root), turned, 1.0 / frame_rate, translations)


class Kinematics(eqx.Module):
    """What forward kinematics returns. Computed once per evaluation; every term reads it.

    `positions_world` [m] and `rotations_world` of all joints, the `rotations_parent` they came from, the bind pose's
    `positions_bind` [m] and `rotations_bind` in the world, `dt` [s], and `signals`, the values of the problem's
    controls in each frame [rad] (none without a correction). Under jit, what no term reads is not computed.
    """

    positions_world: Positions
    rotations_world: Rotations
    rotations_parent: Rotations
    positions_bind: Float[AnyArray, "joints 3"]
    rotations_bind: Float[AnyArray, "joints 4"]
    dt: Float[AnyArray, ""]
    signals: Float[AnyArray, "frames controls"]

    def skin_transforms(
        self, joints: Int[AnyArray, " some"] | slice = slice(None)
    ) -> tuple[Float[Array, "frames some 3 3"], Float[Array, "frames some 3"]]:
        """Rotation matrices and translations [m] that take a bind-pose point to the world with each joint:
        M_j B_j^-1 of thesis (4.20)."""
        turn = rotation.multiply(self.rotations_world[:, joints], rotation.conjugate(self.rotations_bind[joints]))
        matrices = rotation.to_matrix(turn)
        return matrices, jnp.asarray(self.positions_world)[:, joints] - rotation.matrix_times(
            matrices, self.positions_bind[joints]
        )


def forward_kinematics(
    skeleton: Skeleton, motion: Motion, signals: Float[AnyArray, "frames controls"] | None = None
) -> Kinematics:
    """World position and rotation of every joint in every frame.

    Level by level over the static tree: all joints of one depth are turned at once, each quaternion component
    being a (joints of the level, frames) array. For 31 joints this is some fifty times faster on the CPU than
    one joint after the other, since the work is in long contiguous vectors. The levels are padded to one width and
    scanned, so that the program that XLA compiles is one level's, whatever the tree. Derivatives are in closed form.
    The bind pose rides along as one more frame.
    """
    frames = motion.root.shape[0]
    rotations = jnp.asarray(motion.rotations)
    offsets, rest = jnp.asarray(skeleton.offsets), jnp.asarray(skeleton.rest_rotations)
    dtype = rotations.dtype
    local = jnp.transpose(jnp.concatenate([rotations, rest[None].astype(dtype)]), (2, 1, 0))  # (4, joints, frames + 1)
    root = jnp.concatenate([jnp.asarray(motion.root), offsets[:1]]).astype(dtype).T
    places_parent = offsets.astype(dtype).T[:, :, None]  # (3, joints, 1)
    if motion.translations is not None:
        moving = jnp.transpose(jnp.asarray(motion.translations).astype(dtype), (2, 1, 0))
        places_parent = jnp.concatenate([moving, places_parent], axis=2)
    turned, positions = _poses((*local,), (*root,), (*places_parent,), parents=skeleton.parents)
    turned, positions = (jnp.transpose(jnp.stack(x, axis=-1), (1, 0, 2)) for x in (turned, positions))
    return Kinematics(
        positions_world=positions[:-1],
        rotations_world=turned[:-1],
        rotations_parent=rotations,
        positions_bind=positions[-1],
        rotations_bind=turned[-1],
        dt=jnp.asarray(motion.dt),
        signals=jnp.zeros((frames, 0), dtype) if signals is None else signals,
    )


@eqx.filter_custom_jvp
def _poses(local, root, places_parent, *, parents):
    """World rotations and positions, level by level; one (joints, frames) array per component."""
    joints, above_in_level, places = _padded_levels(parents)

    def level(above, at):
        (turn, place), (own, offset, parent) = above, at
        turn, place = jax.tree.map(lambda x: x[parent], (turn, place))
        both = _product(turn, own), _sum(place, _rotated(turn, offset))
        return both, both

    width = joints.shape[1]
    top = tuple(x[:1] for x in local), tuple(x[None] for x in root)
    wide = jax.tree.map(lambda x: jnp.repeat(x, width, axis=0), top)
    below = (*jax.tree.map(lambda x: x[joints], (local, places_parent)), above_in_level)
    _, reached = jax.lax.scan(level, wide, below)
    # (levels, width, frames) -> (joints, frames), the root first
    return jax.tree.map(lambda one, x: jnp.concatenate([one, x.reshape(-1, x.shape[-1])[places]]), top, reached)


@_poses.def_jvp
def _poses_jvp(primals, tangents, *, parents):
    """The velocity of a tree in closed form: each joint adds its own turn, as seen in the world, to all below it, and
    each bone its own displacement. Both sums are products with the matrix of ancestors.

    A turn is the quaternion d q q^-1: half the angular velocity, and the change of length, which is zero for those
    who stay on the sphere.
    """
    local, root, places_parent = primals
    t_local, t_root, t_places = tangents
    turned, positions = _poses(local, root, places_parent, parents=parents)
    above = np.maximum(parents, 0)
    ancestors = jnp.asarray(_ancestors(parents), local[0].dtype)
    below_root = jnp.asarray(np.arange(len(above)) > 0, local[0].dtype)[:, None]
    around = tuple(x[above] * below_root for x in turned)
    around = (around[0].at[0].set(1.0), *around[1:])
    t_turned, velocity = (jax.tree.map(jnp.zeros_like, x) for x in (turned, positions))
    if any(t is not None for t in t_local):
        t_local = tuple(jnp.zeros_like(x) if t is None else t for x, t in zip(local, t_local, strict=True))
        own = _product(t_local, (local[0], *(-x for x in local[1:])))
        turn = tuple(ancestors @ x for x in (own[0], *_rotated(around, own[1:])))
        t_turned = _product(turn, turned)
        # a bone swings with the joint above it
        half, *spin = (x[above] * below_root for x in turn)
        bones = tuple(x - x[above] for x in positions)
        stretched = tuple(half * (bone - rest) for bone, rest in zip(bones, places_parent, strict=True))
        velocity = tuple(2 * (a + b) for a, b in zip(_cross(spin, bones), stretched, strict=True))
    if any(t is not None for t in t_places):
        shape = positions[0].shape
        own = tuple(jnp.zeros(shape) if t is None else jnp.broadcast_to(t, shape) * below_root for t in t_places)
        velocity = _sum(velocity, _rotated(around, own))
    velocity = tuple(v if t is None else v.at[0].add(t) for v, t in zip(velocity, t_root, strict=True))
    return (turned, positions), (t_turned, tuple(ancestors @ v for v in velocity))


def _ancestors(parents: tuple[int, ...]) -> Bool[np.ndarray, "joints joints"]:
    """Row j: the joint itself and all joints above it."""
    matrix = np.eye(len(parents), dtype=bool)
    for joint, parent in enumerate(parents[1:], start=1):
        matrix[joint] |= matrix[parent]
    return matrix


# quaternions and vectors as tuples of components: each is one long contiguous vector, and nothing is stacked in between
def _sum(a, b):
    return tuple(x + y for x, y in zip(a, b, strict=True))


def _cross(a, b):
    (ax, ay, az), (bx, by, bz) = a, b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def _product(a, b):
    (aw, *u), (bw, *v) = a, b
    vector = tuple(aw * y + bw * x + c for x, y, c in zip(u, v, _cross(u, v), strict=True))
    return aw * bw - sum(x * y for x, y in zip(u, v, strict=True)), *vector


def _rotated(q, v):
    w, *u = q
    twice = tuple(2 * c for c in _cross(u, v))
    return tuple(x + w * y + c for x, y, c in zip(v, twice, _cross(u, twice), strict=True))


def _padded_levels(parents: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joints of every level below the root, padded to one width; their parents' places in the level above; and the
    place of every joint but the root in the flattened levels."""
    depths = _ancestors(parents).sum(axis=1) - 1
    levels = [np.flatnonzero(depths == depth).tolist() for depth in range(max(depths) + 1)]
    width = max(len(level) for level in levels)
    joints, above = (np.zeros((len(levels) - 1, width), np.int32) for _ in range(2))
    places = np.zeros(len(parents), np.int32)
    for k, (upper, level) in enumerate(zip(levels, levels[1:], strict=False)):
        joints[k, : len(level)] = level
        above[k, : len(level)] = [upper.index(parents[j]) for j in level]
        places[level] = k * width + np.arange(len(level))
    return joints, above, places[1:]


def host_kinematics(
    motion: Motion, joints: Iterable[int] | None = None
) -> tuple[Float[np.ndarray, "frames joints 3"], Float[np.ndarray, "frames joints 4"]]:
    """World positions [m] and rotations in double precision whatever JAX's mode is, without compiling anything:
    for files, set-up and measures. Of all joints, or of `joints` and those above them: the others are NaN then."""
    skeleton, parents = motion.skeleton, np.array(motion.skeleton.parents)
    needed = {0}
    for joint in range(len(parents)) if joints is None else joints:
        while joint not in needed:
            needed.add(joint)
            joint = skeleton.parents[joint]
    some = sorted(needed)
    local = np.asarray(motion.rotations)[:, some].astype(float)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    offsets = np.asarray(skeleton.offsets, float)[some, :, None]
    if motion.translations is not None:
        offsets = np.asarray(motion.translations, float)[:, some, :, None]
    world, positions = (np.full((motion.frame_count, len(parents), k), np.nan) for k in (4, 3))
    world[:, some], positions[:, 0] = local, np.asarray(motion.root, float)
    below = [own for level in skeleton.levels[1:] if (own := [j for j in level if j in needed])]
    for own in below:
        world[:, own] = host_product(world[:, parents[own]], world[:, own])
    bones = np.empty_like(positions)
    bones[:, some] = (host_matrices(world[:, parents[some]]) @ offsets)[..., 0]
    for own in below:
        positions[:, own] = positions[:, parents[own]] + bones[:, own]
    return positions, world


CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])  # times a unit quaternion: its inverse
# p q = (signed p in the order of this table) times q
_LEFT = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGNS = np.array([[1.0, -1, -1, -1], [1, 1, -1, 1], [1, 1, 1, -1], [1, -1, 1, 1]])


def host_product(p: Float[np.ndarray, "... 4"], q: Float[np.ndarray, "... 4"]) -> Float[np.ndarray, "... 4"]:
    """Products of quaternions, on the host: a tenth of SciPy's time for a hundred of them."""
    return np.einsum("...ij,...j->...i", p[..., _LEFT] * _SIGNS, q)


def host_matrices(q: Float[np.ndarray, "... 4"]) -> Float[np.ndarray, "... 3 3"]:
    """Rotation matrices of unit quaternions, on the host."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    m = np.empty((*q.shape[:-1], 3, 3))
    m[..., 0, 0], m[..., 0, 1], m[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    m[..., 1, 0], m[..., 1, 1], m[..., 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    m[..., 2, 0], m[..., 2, 1], m[..., 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return m


def bind_pose(skeleton: Skeleton) -> tuple[Float[np.ndarray, "joints 3"], Float[np.ndarray, "joints 4"]]:
    """World position [m] and rotation of every joint in the bind pose, on the host."""
    if "bind_pose" not in skeleton.memo:
        positions, rotations = host_kinematics(rest_motion(skeleton))
        skeleton.memo["bind_pose"] = positions[0], rotations[0]
    positions, rotations = skeleton.memo["bind_pose"]
    return positions.copy(), rotations.copy()


def joint_angles(a: Motion, b: Motion) -> Float[np.ndarray, "frames joints"]:
    """The angle [rad] between two motions of one skeleton, per frame and joint, in double precision."""
    shape = a.rotations.shape[:2]
    first, second = (
        Rotation.from_quat(np.asarray(m.rotations, float).reshape(-1, 4), scalar_first=True) for m in (a, b)
    )
    return (first.inv() * second).magnitude().reshape(shape)

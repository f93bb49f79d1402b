"""Random skeletons and motions, and independent oracles."""

import equinox as eqx
import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from motionfit import Character, Motion, Skeleton, Skin
from motionfit._motion import bind_pose, host_kinematics, rest_motion


def random_motion(seed: int, joints: int, frames: int, rate: float = 60.0) -> Motion:
    """A random tree with random rest pose and rotations."""
    rng = np.random.default_rng(seed)
    parents = [-1] + [int(rng.integers(0, j)) for j in range(1, joints)]

    def turns(*shape):
        flat = Rotation.random(int(np.prod(shape)), random_state=rng).as_quat(scalar_first=True)  # pyright: ignore[reportCallIssue]: the name before SciPy 1.15
        return flat.reshape(*shape, 4)

    skeleton = Skeleton([f"joint{j}" for j in range(joints)], parents, rng.normal(size=(joints, 3)), turns(joints))
    return Motion(skeleton, rng.normal(size=(frames, 3)), turns(frames, joints), 1.0 / rate)


# the arguments of `random_motion`: built in the test, since the type checks of construction use `random`
motions = st.tuples(st.integers(0, 2**31), st.integers(1, 12), st.integers(1, 6))


def matrices(motion: Motion, frame: int) -> np.ndarray:
    """World matrices of all joints by 4x4 products: the oracle of forward kinematics."""
    result = []
    for j, parent in enumerate(motion.skeleton.parents):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_quat(np.asarray(motion.rotations)[frame, j], scalar_first=True).as_matrix()
        local[:3, 3] = np.asarray(motion.root)[frame] if parent < 0 else np.asarray(motion.skeleton.offsets)[j]
        result.append(local if parent < 0 else result[parent] @ local)
    return np.stack(result)


def central_difference(fn, x: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Gradient of a scalar function by central differences in double precision."""
    gradient = np.zeros_like(x)
    for i in np.ndindex(x.shape):
        up, down = x.copy(), x.copy()
        up[i] += step
        down[i] -= step
        gradient[i] = (float(fn(up)) - float(fn(down))) / (2 * step)
    return gradient


def with_legs(character: Character, scale: float) -> Character:
    """The character with thighs and calves `scale` times as long, standing on the same floor; skin stretched along."""
    skeleton, skin = character.skeleton, character.skin
    old = bind_pose(skeleton)[0]
    offsets, stretch = np.array(skeleton.offsets, float), np.zeros((len(old), 3, 3))
    for side in ("left", "right"):
        for joint, end in (("thigh", "calf"), ("calf", "foot")):
            a, b = (skeleton.joint(f"{side}_{r}") for r in (joint, end))
            bone = (old[b] - old[a]) / np.linalg.norm(old[b] - old[a])
            stretch[a] = (scale - 1.0) * np.outer(bone, bone)
            offsets[b] *= scale
    foot = skeleton.joint("left_foot")
    lowered = bind_pose(eqx.tree_at(lambda s: s.offsets, skeleton, offsets))[0][foot, 1]
    offsets[0, 1] += old[foot, 1] - lowered
    longer = eqx.tree_at(lambda s: s.offsets, skeleton, offsets)
    joints, weights, vertices = np.asarray(skin.joints), np.asarray(skin.weights), np.asarray(skin.vertices_bind)
    moved = vertices + np.einsum("vk,vka->va", weights, (bind_pose(longer)[0] - old)[joints])
    moved = moved + np.einsum("vk,vkab,vkb->va", weights, stretch[joints], vertices[:, None] - old[joints])
    return Character(longer, Skin(moved, skin.faces, skin.joints, skin.weights), f"{character.name} legs {scale:g}")


def jumping(body: Character, height: float, rate: float = 60.0) -> tuple[Motion, np.ndarray]:
    """The bind pose standing, in ballistic flight, and standing; with the frames in the air."""
    rest = rest_motion(body.skeleton, 1 / rate)
    flight = np.sqrt(8 * height / 9.81)
    times = np.arange(round((1.0 + flight) * rate)) / rate - 0.5
    up = np.where((times > 0) & (times < flight), 9.81 / 2 * times * (flight - times), 0.0)
    root = np.asarray(rest.root) + up[:, None] * [0.0, 1.0, 0.0] + np.clip(times, 0, flight)[:, None] * [0.0, 0.0, 0.8]
    rotations = np.repeat(np.asarray(rest.rotations), len(times), axis=0)
    return Motion(body.skeleton, root, rotations, 1 / rate), up > 0


def knee_accelerations(motion: Motion) -> np.ndarray:
    """Size of the second differences [rad] of both knees' bend: (2, frames - 2)."""
    positions, joint = host_kinematics(motion)[0], motion.skeleton.joint
    bends = []
    for side in ("left", "right"):
        hip, knee, ankle = (positions[:, joint(f"{side}_{r}")] for r in ("thigh", "calf", "foot"))
        a, b = knee - hip, ankle - knee
        bends.append(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1)))
    return np.abs(np.diff(bends, 2, axis=1))

"""Built-in clips: a human walk from a few harmonics per joint, with feet that stay where they are planted.

How the segments turn over the gait cycle comes from motion capture (see `_walk_harmonics.py` for the credit); what
the legs do is put right by geometry. In stance the sole rolls over its heel, lies flat, and rises over its ball;
the ankle follows from that, and the knee from the ankle (law of cosines). In swing the ankle keeps the captured
path, plus a quintic that joins the two stances with continuous velocity and acceleration.
"""

import numpy as np
from scipy.interpolate import BPoly, CubicSpline
from scipy.spatial.transform import Rotation

from motionfit._motion import Motion, bind_pose
from motionfit._onto import between
from motionfit._skeleton import Skeleton
from motionfit._types import InputError
from motionfit._walk_harmonics import HARMONICS
from motionfit.shape.bodies import builtin_skeleton

# Phases of the cycle, which begins where the left ankle is furthest forward, a little before the heel strikes.
# Perry & Burnfield, Gait Analysis (2010): stance takes 60 to 62 % of the cycle.
STRIKE, LIFT = 0.045, 0.655
FLAT = (0.115, 0.38)  # foot flat to heel rise
MOST_BEND = 1.1  # [rad] of the toes; Perry & Burnfield: about 55 degrees before the foot leaves the ground
DENSE = 480  # samples of one cycle on which the leg paths are laid out


def walk(frame_rate: float = 60.0, cycles: int = 5, body: str = "average") -> Motion:
    """A steady walk straight ahead on a built-in skeleton, at a comfortable speed, starting at a left heel strike.

    `frame_rate` [1/s], `cycles` whole gait cycles of two steps each.
    """
    if not 1 <= frame_rate <= 1000 or cycles < 1:
        raise InputError(f"a walk needs 1 to 1000 frames per second and a cycle at least; got {frame_rate}, {cycles}")
    skeleton = builtin_skeleton(body)
    gait = _Gait(skeleton)
    frames = int(round(cycles * gait.duration * frame_rate)) + 1
    times = np.arange(frames) / frame_rate
    return gait.motion(times, 1.0 / frame_rate)


CLIPS = {"walk": walk}


def _turn(role: str, phase: np.ndarray, side: str | None = None) -> np.ndarray:
    """The harmonics of a role at a phase (0..1 from left heel strike): rotation vectors (frames, 3), or the pelvis."""
    shifted = phase - 0.5 if side == "right" else phase
    rows = np.array(HARMONICS[role])
    angles = 2 * np.pi * np.outer(shifted, np.arange(1, (len(rows) - 1) // 2 + 1))
    basis = np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(len(phase), -1)
    curve = rows[0] + basis @ rows[1:]
    return curve * np.array([1.0, -1.0, -1.0]) if side == "right" else curve


class _Gait:
    """The walk of one skeleton as functions of time."""

    def __init__(self, skeleton: Skeleton):
        self.skeleton = skeleton
        self.bind, _ = bind_pose(skeleton)
        joint = {role: skeleton.joint(role) for role, _ in skeleton.roles}
        self.joint = joint
        self.thigh, self.shank = (
            float(np.linalg.norm(self.bind[joint[f"left_{b}"]] - self.bind[joint[f"left_{a}"]]))
            for a, b in (("thigh", "calf"), ("calf", "foot"))
        )
        leg = self.thigh + self.shank
        self.leg = leg
        ((stride, period),) = HARMONICS["stride"]
        self.stride, self.duration = stride * leg, period * np.sqrt(leg / 9.81)
        # the sole in the foot's frame, below the ankle: it lies on the ground at bind
        ankle = self.bind[joint["left_foot"]]
        self.heel = np.array([0.0, -ankle[1], -0.021 * self._height()])
        ball = self.bind[joint["left_toe"]] - ankle
        self.ball = np.array([0.0, -ankle[1], ball[2] + 0.006 * self._height()])
        dense = np.arange(DENSE) / DENSE
        self.toes = 0.052 * self._height()  # from the joint to the tip of the skin
        self.pitch = self._pitch_curve(dense)
        self.height_offset = 0.0
        self.ankle_path = {}
        for _ in range(2):
            paths = {side: self._ankle_curve(side) for side in ("left", "right")}
            self.height_offset -= max(self._overreach(side, paths[side]) for side in paths)
        for side, path in paths.items():
            closed = np.concatenate([path, path[:1]])
            self.ankle_path[side] = CubicSpline(np.append(dense, 1.0), closed, bc_type="periodic")

    def _height(self) -> float:
        ends = np.asarray(self.skeleton.end_offsets)
        top = self.bind[list(self.skeleton.end_parents)] + ends
        return float(top[:, 1].max())

    def _pitch_curve(self, dense: np.ndarray) -> CubicSpline:
        """Foot pitch [rad] over the cycle (positive: toes down), exactly zero while the foot is flat."""
        raw = _turn("foot", dense)[:, 0]
        middle = (dense > FLAT[0]) & (dense < FLAT[1])
        raw = raw - raw[middle].mean()

        into, out = _ease((FLAT[0] + 0.02 - dense) / 0.09), _ease((dense - FLAT[1] + 0.03) / 0.14)
        curve = raw * np.maximum(into, out)
        return CubicSpline(np.append(dense, 1.0), np.append(curve, curve[0]), bc_type="periodic")

    def _pelvis(self, phase: np.ndarray) -> np.ndarray:
        """Hip centre in the frame that advances steadily: (frames, 3) [m], heights over the ground."""
        offset = _turn("pelvis", phase) * self.leg
        # the captured height is over the lowest toe joint; ours over the sole
        offset[:, 1] = (
            0.955 * self.leg
            + self.bind[self.joint["left_foot"]][1]
            + self.height_offset
            + (offset[:, 1] - HARMONICS["pelvis"][0][1] * self.leg)
        )
        return offset

    def _hips(self, phase: np.ndarray) -> Rotation:
        return Rotation.from_rotvec(_turn("hips", phase))

    def _hip_joint(self, side: str, phase: np.ndarray) -> np.ndarray:
        both = [self.bind[self.joint[f"{s}_thigh"]] for s in ("left", "right")]
        return self._pelvis(phase) + self._hips(phase).apply(
            self.bind[self.joint[f"{side}_thigh"]] - np.mean(both, axis=0)
        )

    def _yaw(self, side: str) -> float:
        """Toes a little out, the same through the cycle: a planted foot must not turn."""
        return 0.10 if side == "left" else -0.10

    def _foot_turn(self, side: str, phase: np.ndarray) -> Rotation:
        own = phase - 0.5 if side == "right" else phase
        pitch = self.pitch(np.mod(own, 1.0))
        return Rotation.from_euler("Y", self._yaw(side)) * Rotation.from_rotvec(pitch[:, None] * np.array([1.0, 0, 0]))

    def _ankle_curve(self, side: str) -> np.ndarray:
        """The ankle over one cycle in the advancing frame (DENSE, 3): rolling stance, joined swing."""
        phase = np.arange(DENSE) / DENSE
        # cyclic phase since this foot's strike
        own = np.mod(phase - STRIKE - (0.5 if side == "right" else 0.0), 1.0)
        captured = self._hip_joint(side, phase)
        for bone, length in (("thigh", self.thigh), ("calf", self.shank)):
            captured = captured + length * Rotation.from_rotvec(_turn(bone, phase, side)).apply([0, -1.0, 0])
        order = np.argsort(own)
        own, captured = own[order], captured[order]
        turn = self._foot_turn(side, phase[order])
        # stance: heel fixed, then ball fixed; seen from the advancing frame both go back steadily
        heel, ball = turn.apply(self.heel), turn.apply(self.ball)
        yaw = Rotation.from_euler("Y", self._yaw(side))
        flat_heel, flat_ball = yaw.apply(self.heel), yaw.apply(self.ball)
        pitch = self.pitch(np.mod(own + STRIKE, 1.0))
        over_heel = np.where(pitch[:, None] < 0, flat_heel - heel, flat_ball - ball)
        back = np.zeros((DENSE, 3))
        back[:, 2] = -self.stride * own
        rolled = over_heel + back
        rolled[:, 1] += self.bind[self.joint["left_foot"]][1]
        stance = own <= LIFT - STRIKE
        # plant the foot where the captured one is on the mean over its flat time
        flat = (own > FLAT[0] - STRIKE) & (own < FLAT[1] - STRIKE)
        rolled[:, [0, 2]] += (captured - rolled)[flat].mean(0)[[0, 2]]
        error = rolled - captured
        ends = np.flatnonzero(stance)[[0, -1]].tolist()
        step = 1.0 / DENSE

        def jet(index: int, inward: int) -> list[np.ndarray]:
            e0, e1, e2 = (error[index + inward * k] for k in range(3))
            return [e0, inward * (-1.5 * e0 + 2 * e1 - 0.5 * e2) / step, (e0 - 2 * e1 + e2) / step**2]

        lift, strike = own[ends[1]], 1.0 + own[ends[0]]
        joined = BPoly.from_derivatives([lift, strike], [jet(ends[1], -1), jet(ends[0], 1)])
        result = np.where(stance[:, None], rolled, captured)
        result[~stance] += joined(own[~stance])
        # the swinging sole clears the ground: as far as the lowest of heel and ball would not, the foot is lifted
        arch = np.where(stance, 0.0, np.sin(np.pi * np.clip((own - lift) / (1 - lift), 0, 1)) ** 3)
        short = 0.014 * arch - np.minimum(heel[:, 1], ball[:, 1]) - result[:, 1]
        result[:, 1] += np.where(stance, 0.0, 0.5 * (short + np.sqrt(short**2 + (0.02 * arch) ** 2)))
        unsorted = np.empty_like(result)
        unsorted[order] = result
        return unsorted

    def _overreach(self, side: str, path: np.ndarray) -> float:
        """How much too far [m] the ankle is from the hip at worst: the pelvis comes down by that."""
        hip = self._hip_joint(side, np.arange(DENSE) / DENSE)
        return float(max(0.0, (np.linalg.norm(path - hip, axis=1) - 0.9965 * self.leg).max()))

    def motion(self, times: np.ndarray, dt: float) -> Motion:
        """The walk at the given times [s]."""
        skeleton, joint = self.skeleton, self.joint
        phase = np.mod(times / self.duration, 1.0)
        progress = np.zeros((len(times), 3))
        progress[:, 2] = self.stride * times / self.duration
        world: dict[int, Rotation] = {}
        spine, neck = skeleton.chain("spine"), skeleton.chain("neck")
        names = {joint["hips"]: "hips", joint["head"]: "head"}
        names |= dict(zip(spine, ("spine_0", "spine_1", "chest"), strict=True))
        names |= dict(zip(neck, ("neck_0", "neck_1"), strict=True))
        for index, role in names.items():
            world[index] = Rotation.from_rotvec(_turn(role, phase))
        for side, sign in (("left", 1.0), ("right", -1.0)):
            world[joint[f"{side}_clavicle"]] = Rotation.from_rotvec(_turn("clavicle", phase, side))
            level = np.array([sign, 0.0, 0.0])
            for role, end in (("upper_arm", "forearm"), ("forearm", "hand"), ("hand", None)):
                a = joint[f"{side}_{role}"]
                bone = self.bind[joint[f"{side}_{end}"]] - self.bind[a] if end else bone
                laid = between(bone / np.linalg.norm(bone), level)
                world[a] = Rotation.from_rotvec(_turn(role, phase, side)) * laid
            self._leg(side, phase, world)
        pelvis = self._pelvis(phase) + progress
        both = np.mean([self.bind[joint[f"{s}_thigh"]] for s in ("left", "right")], axis=0)
        root = pelvis + world[0].apply(self.bind[0] - both)
        local = np.empty((len(times), len(skeleton.names), 4))
        for j, parent in enumerate(skeleton.parents):
            if j not in world:  # fingers and hip helpers go with the joint that carries them
                world[j] = world[parent]
            above = world[parent] if parent >= 0 else Rotation.identity(len(times))
            local[:, j] = (above.inv() * world[j]).as_quat(scalar_first=True)
        return Motion(skeleton, root, local, np.asarray(dt))

    def _leg(self, side: str, phase: np.ndarray, world: dict[int, Rotation]) -> None:
        """Two-bone leg: the ankle is given, the knee lies in the captured plane."""
        joint = self.joint
        hip = self._hip_joint(side, phase)
        ankle = self.ankle_path[side](phase)
        reach = ankle - hip
        distance = np.minimum(np.linalg.norm(reach, axis=1), 0.9995 * self.leg)
        axis = reach / np.linalg.norm(reach, axis=1, keepdims=True)
        # the knee bends forward, in the plane of the leg and the foot's direction
        forward = Rotation.from_euler("Y", 0.5 * self._yaw(side)).apply([0.0, 0.0, 1.0])
        pole = forward - (axis @ forward)[:, None] * axis
        pole /= np.linalg.norm(pole, axis=1, keepdims=True)
        cosine = (self.thigh**2 + distance**2 - self.shank**2) / (2 * self.thigh * distance)
        sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
        thigh = cosine[:, None] * axis + sine[:, None] * pole
        knee = hip + self.thigh * thigh
        shank = (hip + distance[:, None] * axis - knee) / self.shank
        side_way = np.cross(thigh, pole)
        side_way = np.where((sine > 1e-6)[:, None], np.cross(axis, pole), side_way)
        for role, bone in (("thigh", thigh), ("calf", shank)):
            a, b = (self.bind[joint[f"{side}_{r}"]] for r in (role, {"thigh": "calf", "calf": "foot"}[role]))
            rest = (b - a) / np.linalg.norm(b - a)
            world[joint[f"{side}_{role}"]] = (
                _frames(bone, side_way) * _frames(rest[None], np.array([[-1.0, 0, 0]])).inv()
            )
        turn = self._foot_turn(side, phase)
        world[joint[f"{side}_foot"]] = turn
        # toes stay on the ground while the heel rises, and come up again no faster than the ball leaves it
        own = np.mod(phase - (0.5 if side == "right" else 0.0), 1.0)
        pitch = self.pitch(own)
        bend = np.clip(pitch, 0.0, MOST_BEND) * _ease((LIFT + 0.06 - own) / 0.08)
        toe = self.bind[joint[f"{side}_toe"]] - self.bind[joint[f"{side}_foot"]]
        height = ankle[:, 1] + turn.apply(toe)[:, 1] - self.bind[joint[f"{side}_toe"]][1]
        least = pitch - np.arcsin(np.clip((height - 0.004) / self.toes, 0.0, 1.0))
        bend = 0.5 * (bend + least + np.sqrt((bend - least) ** 2 + 0.03**2))
        bend = np.clip(bend, 0.0, MOST_BEND) * _ease(pitch / 0.1)
        world[joint[f"{side}_toe"]] = turn * Rotation.from_rotvec(-bend[:, None] * np.array([1.0, 0, 0]))


def _ease(x: np.ndarray) -> np.ndarray:
    """0 to 1 with zero first and second derivative at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (x * (6 * x - 15) + 10)


def _frames(axis: np.ndarray, across: np.ndarray) -> Rotation:
    """Frames whose first axis is `axis` and whose second lies towards `across`."""
    second = across - (axis * across).sum(1, keepdims=True) * axis
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([axis, second, np.cross(axis, second)], axis=2))

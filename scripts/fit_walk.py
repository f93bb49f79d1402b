"""Fit the harmonics of the built-in walk to walks of the CMU motion capture database.

    python scripts/fit_walk.py FOLDER_WITH_WALKS > motionfit/_walk_harmonics.py

FOLDER_WITH_WALKS holds walk_07_01.bvh and the like (cgspeed's BVH layout, T-pose first). Per role: how the segment
turns in the world away from the T-pose, as a rotation vector in the frame of the walking direction, over the gait
cycle from one left heel strike to the next; the right side is the left one's mirror image half a cycle later.
"""

import pathlib
import sys

import numpy as np
from scipy.signal import find_peaks
from scipy.spatial.transform import Rotation

from motionfit._motion import bind_pose, host_kinematics
from motionfit._onto import leg_length
from motionfit.io.bvh import read_bvh

CLIPS = ("walk_07_01", "walk_08_02", "walk_16_15", "walk_16_47", "walk_16_31")
MIDDLE = ("hips", "spine_0", "spine_1", "chest", "neck_0", "neck_1", "head")
SIDED = ("clavicle", "upper_arm", "forearm", "hand", "thigh", "calf", "foot", "toe")
HARMONICS, SAMPLES = 5, 120
MIRROR = np.array([1.0, -1.0, -1.0])  # a rotation vector seen in the mirror x -> -x


def cycles(path: pathlib.Path) -> list[dict[str, np.ndarray]]:
    """The gait cycles of a clip: rotation vectors per role, pelvis offsets over leg length, stride and duration."""
    motion = read_bvh(path)
    skeleton = motion.skeleton
    positions, world = host_kinematics(motion)
    rest_positions, rest = bind_pose(skeleton)
    way = motion.root[-1] - motion.root[0]
    heading = Rotation.from_rotvec([0, -np.arctan2(way[0], way[2]), 0])
    # the T-pose faces +z, and so does the walker once the heading is taken off
    away = {
        role: heading
        * Rotation.from_quat(world[:, j], scalar_first=True)
        * Rotation.from_quat(rest[j], scalar_first=True).inv()
        for role, j in skeleton.roles
    }
    root = heading.apply(motion.root)
    ankle = heading.apply(positions[:, skeleton.joint("left_foot")])
    forward = ankle[:, 2] - root[:, 2]
    strikes, _ = find_peaks(forward, distance=0.6 / float(motion.dt), prominence=0.2)
    leg = leg_length(skeleton, rest_positions)
    found = []
    for start, end in zip(strikes, strikes[1:], strict=False):
        duration = (end - start) * float(motion.dt)
        if not 0.8 < duration < 1.5:
            continue
        phase = np.linspace(start, end, SAMPLES, endpoint=False)
        frames = np.arange(len(root))

        def at(x, phase=phase, frames=frames):
            return np.stack([np.interp(phase, frames, c) for c in x.T], axis=1)

        path_z = root[start, 2] + (root[end, 2] - root[start, 2]) * np.arange(SAMPLES) / SAMPLES
        path_x = root[start, 0] + (root[end, 0] - root[start, 0]) * np.arange(SAMPLES) / SAMPLES
        place = at(root)
        cycle = {role: at(turn.as_rotvec()) for role, turn in away.items()}
        hips = np.mean([rest_positions[skeleton.joint(f"{s}_thigh")] for s in ("left", "right")], axis=0)
        drop = rest_positions[0][1] - hips[1]
        ground = min(positions[start:end, skeleton.joint(f"{s}_toe"), 1].min() for s in ("left", "right"))
        cycle["pelvis"] = (
            np.stack([place[:, 0] - path_x, place[:, 1] - drop - ground, place[:, 2] - path_z], axis=1) / leg
        )
        cycle["stride"] = np.array([(root[end, 2] - root[start, 2]) / leg, duration / np.sqrt(leg / 9.81)])
        found.append(cycle)
    return found


def symmetric(cycle: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The mean of a cycle and its mirror image half a cycle later; the left side stands for both."""
    half = SAMPLES // 2
    result = {
        role: (cycle[role] + np.roll(cycle[role], -half, axis=0) * MIRROR) / 2 for role in MIDDLE if role in cycle
    }
    for role in SIDED:
        left, right = cycle[f"left_{role}"], np.roll(cycle[f"right_{role}"], -half, axis=0) * MIRROR
        result[role] = (left + right) / 2
    result["pelvis"] = (cycle["pelvis"] + np.roll(cycle["pelvis"], -half, axis=0) * np.array([-1, 1, 1])) / 2
    return result


def harmonics(curve: np.ndarray) -> np.ndarray:
    """Mean, cosines and sines of a periodic curve: (1 + 2 HARMONICS, columns)."""
    spectrum = np.fft.rfft(curve, axis=0) / len(curve)
    rows = [spectrum[0].real]
    for k in range(1, HARMONICS + 1):
        rows += [2 * spectrum[k].real, -2 * spectrum[k].imag]
    return np.array(rows)


def fitted(folder: pathlib.Path) -> dict[str, np.ndarray]:
    """The coefficients of every role, of the pelvis, and the mean stride."""
    found = [c for clip in CLIPS for c in cycles(folder / f"{clip}.bvh")]
    curves = [symmetric(c) for c in found]
    result = {role: harmonics(np.mean([c[role] for c in curves], axis=0)) for role in curves[0]}
    result["stride"] = np.mean([c["stride"] for c in found], axis=0)[None]
    return result


def main() -> None:
    """Print the module of coefficients."""
    out = sys.stdout
    coefficients = fitted(pathlib.Path(sys.argv[1]))
    out.write('"""Harmonics of a human walk over one gait cycle. Written by scripts/fit_walk.py; do not edit.\n\n')
    out.write("Per role the rotation vector [rad] in which the segment turns away from the T-pose, in the frame of\n")
    out.write("the walking direction: rows are the mean, then cosine and sine of each harmonic. `pelvis` is the hip\n")
    out.write("centre's offset from steady progress and its height over the ground, over the leg length; `stride`\n")
    out.write("is stride over leg length, and cycle time over sqrt(leg length / g).\n\n")
    out.write("Fitted to walks of subjects 07, 08 and 16 of the CMU database. The data used in this project was\n")
    out.write("obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.\n")
    out.write('"""\n\nHARMONICS = {\n')
    for role, rows in coefficients.items():
        out.write(f'    "{role}": [\n')
        for row in rows:
            out.write("        [" + ", ".join(f"{x + 0.0:.4f}" for x in row) + "],\n")
        out.write("    ],\n")
    out.write("}\n")


if __name__ == "__main__":
    main()

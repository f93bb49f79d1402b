"""The work of benchmarks/peers.py done by momentum: WORK.npz in, POSES.npz out, one line of JSON on stdout.

Runs in an environment of its own (Python 3.12, pymomentum-cpu), without motionfit: a sequence solve over the Euler angles
of all joints, with momentum's own capsule collision, the clip's pose as target, and a pull between neighbouring frames.
momentum has no depth that does not count: it pushes every pair of capsules apart that is apart in the bind pose, and
leaves out those that touch there (of a heavy body, the upper arms against the chest).
"""

import importlib.metadata
import json
import sys
import time

import numpy as np
import pymomentum.geometry as geometry  # pyright: ignore[reportMissingImports]
import pymomentum.solver2 as solver  # pyright: ignore[reportMissingImports]

ITERATIONS = 20

COLLISION = 1.0  # momentum's own weighting; ten times more is no clearer of overlaps and leaves the motion jerky
SMOOTH = 1.0
CENTIMETRES = 100.0  # momentum's default weights are made for centimetres


def character_of(work) -> geometry.Character:
    """The skeleton with three Euler angles per joint, zero in the bind pose, and the capsules.

    Zero must be a pose without collisions: momentum leaves out every pair that touches there.
    """
    joints = [
        geometry.Joint(
            f"j{k}", int(parent), np.roll(work["rest_rotations"][k], -1).astype(np.float32),
            (CENTIMETRES * (offset if parent >= 0 else np.zeros(3))).astype(np.float32),
        )
        for k, (parent, offset) in enumerate(zip(work["parents"], work["offsets"], strict=True))
    ]  # fmt: skip
    skeleton = geometry.Skeleton(joints)
    names = [f"j{k}_r{axis}" for k in range(len(joints)) for axis in "xyz"]
    transform = np.zeros((7 * len(joints), len(names)), np.float32)
    transform[_angles(len(joints)), np.arange(len(names))] = 1.0
    character = geometry.Character("body", skeleton, geometry.ParameterTransform(names, skeleton, transform))
    capsules = []
    for joint, start, end, radius in zip(
        work["capsule_joint"], work["capsule_start"], work["capsule_end"], work["capsule_radius"], strict=True
    ):
        frame = np.eye(4, dtype=np.float32)
        axis = end - start
        length = float(np.linalg.norm(axis))
        # a capsule lies along the x axis of its frame
        x = axis / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
        y = np.cross(x, np.eye(3)[np.argmin(np.abs(x))])
        y /= np.linalg.norm(y)
        frame[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
        frame[:3, 3] = CENTIMETRES * start
        radii = np.full(2, CENTIMETRES * radius, np.float32)
        capsules.append(geometry.TaperedCapsule(int(joint), frame, radii, CENTIMETRES * length))
    return character.with_collision_geometry(capsules)


def _angles(joint_count: int) -> np.ndarray:
    """Where the Euler angles stand among 7 numbers per joint."""
    return (7 * np.arange(joint_count)[:, None] + np.array([3, 4, 5])).ravel()


def main() -> None:
    """Solve and report."""
    with np.load(sys.argv[1]) as data:
        work = dict(data)
    rotations = work["rotations"]
    frames, joints = rotations.shape[:2]
    character = character_of(work)
    local = np.zeros((frames, joints, 8), np.float32)
    local[..., :3] = CENTIMETRES * np.where((work["parents"] >= 0)[:, None], work["offsets"], 0.0)
    local[..., 3:7] = np.roll(rotations, -1, axis=-1)
    local[..., 7] = 1.0
    found = geometry.local_skeleton_state_to_joint_parameters(character, local).reshape(frames, -1)
    target = np.unwrap(found[:, _angles(joints)], axis=0).astype(np.float32)

    problem = solver.SequenceSolverFunction(character, frames)
    for t in range(frames):
        problem.add_error_function(t, solver.ModelParametersErrorFunction(character, target[t]))
    problem.add_error_function(solver.CollisionErrorFunction(character, weight=COLLISION))
    for t in range(frames - 1):
        problem.add_sequence_error_function(t, solver.ModelParametersSequenceErrorFunction(character, weight=SMOOTH))
    options = solver.SequenceSolverOptions()
    options.min_iterations, options.max_iterations, options.multithreaded = 1, ITERATIONS, True
    start = time.perf_counter()
    solved = solver.solve_sequence(problem, target, options)
    frame_s = (time.perf_counter() - start) / frames

    times = []
    for _ in range(9):
        start = time.perf_counter()
        geometry.model_parameters_to_skeleton_state(character, target)
        times.append((time.perf_counter() - start) / frames)
    state = geometry.model_parameters_to_local_skeleton_state(character, np.asarray(solved, np.float32))
    state = np.asarray(state).reshape(frames, joints, 8)
    np.savez(sys.argv[2], rotations=np.roll(state[..., 3:7], 1, axis=-1))
    note = f"at most {ITERATIONS} iterations (QR), all joints, without pairs that touch at bind"
    version = importlib.metadata.version("pymomentum-cpu")
    told = {"version": version, "frame_s": frame_s, "fk_frame_s": float(np.median(times)), "note": note}
    print(json.dumps(told))


if __name__ == "__main__":
    main()

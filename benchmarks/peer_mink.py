"""The work of benchmarks/peers.py done by mink: WORK.npz in, POSES.npz out, one line of JSON on stdout.

Runs in an environment of its own, without motionfit: differential inverse kinematics, frame after frame. Each frame
starts from the last one's pose, asks for the clip's pose (PostureTask), and may not bring capsules closer than the depth
that does not count (CollisionAvoidanceLimit, one per pair, since each pair and frame has a depth of its own).
"""

import importlib.metadata
import json
import sys
import time

import mink  # pyright: ignore[reportMissingImports]
import mujoco  # pyright: ignore[reportMissingImports]
import numpy as np
import qpsolvers  # pyright: ignore[reportMissingImports]

ITERATIONS = 3  # quadratic programs per frame; one alone lags behind the clip
GAIN = 0.7  # of the pull to the clip's pose; a full step overshoots where a pair holds it back, and chatters
WARM_UP = 100  # for the first frame, which comes from the bind pose

MARGIN = 0.0005  # [m] a pair that is too close is pushed apart by that much per iteration


def model_of(work) -> tuple[mujoco.MjModel, list[str]]:
    """Joints as ball joints, so that qpos holds their quaternions; capsules as geoms. The root stays in place: where
    it is does not matter to what the body parts do to each other."""
    parents = work["parents"]
    children = {j: [k for k, p in enumerate(parents) if p == j] for j in range(-1, len(parents))}
    capsules = [f"capsule_{k}" for k in range(len(work["capsule_joint"]))]

    def xml(joint: int) -> str:
        place = work["offsets"][joint] if parents[joint] >= 0 else np.zeros(3)
        text = f'<body name="b{joint}" pos="{_text(place)}"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        text += f'<joint name="j{joint}" type="ball"/>'
        for k in np.flatnonzero(work["capsule_joint"] == joint):
            start, end, radius = (work[f"capsule_{what}"][k] for what in ("start", "end", "radius"))
            if np.linalg.norm(end - start) > 1e-6:
                shape = f'type="capsule" fromto="{_text([*start, *end])}"'
            else:  # as wide as it is long
                shape = f'type="sphere" pos="{_text(start)}"'
            text += f'<geom name="{capsules[k]}" {shape} size="{radius:.9g}"/>'
        return text + "".join(xml(c) for c in children[joint]) + "</body>"

    world = "".join(xml(j) for j in children[-1])
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{world}</worldbody></mujoco>"), capsules


def _text(values) -> str:
    return " ".join(f"{v:.9g}" for v in values)


def main() -> None:
    """Solve and report."""
    with np.load(sys.argv[1]) as data:
        work = dict(data)
    model, capsules = model_of(work)
    order = np.array([model.joint(f"j{k}").qposadr[0] for k in range(len(work["parents"]))])
    places = (order[:, None] + np.arange(4)).ravel()
    frames = len(work["rotations"])
    # mink bounds the step of one QP by (distance / dt); with the clip's dt that is sixty times the distance, and poses
    # jump through each other. In units of one step both sides are the same.
    dt = 1.0

    def pose(rotations):
        q = np.empty(model.nq)
        q[places] = rotations.ravel()
        return q

    limits, rows = [], []
    for row, (a, b) in enumerate(zip(work["first"], work["second"], strict=True)):
        limit = mink.CollisionAvoidanceLimit(
            model, [([capsules[a]], [capsules[b]])], collision_detection_distance=0.05, bound_relaxation=-MARGIN
        )
        if limit.max_num_contacts:  # mink leaves out neighbours in the tree
            limits.append(limit)
            rows.append(row)
    solver = "daqp" if "daqp" in qpsolvers.available_solvers else qpsolvers.available_solvers[0]
    configuration = mink.Configuration(model, q=pose(work["rest_rotations"]))
    task = mink.PostureTask(model, cost=1.0, gain=GAIN)
    made, infeasible = np.empty_like(work["rotations"]), 0

    def frame(t: int, iterations: int) -> None:
        nonlocal infeasible
        task.set_target(pose(work["rotations"][t]))
        for limit, row in zip(limits, rows, strict=True):
            limit.minimum_distance_from_collisions = -float(work["allowed"][t, row])
        for _ in range(iterations):
            try:
                velocity = mink.solve_ik(configuration, [task], dt, solver, damping=1e-6, limits=limits)
            except mink.NoSolutionFound:  # pairs that cannot all give way at once: the pose stays
                infeasible += 1
                return
            configuration.integrate_inplace(velocity, dt)

    frame(0, WARM_UP)
    start = time.perf_counter()
    for t in range(frames):
        frame(t, ITERATIONS)
        made[t] = configuration.q[places].reshape(-1, 4)
    frame_s = (time.perf_counter() - start) / frames
    start = time.perf_counter()
    for t in range(frames):
        configuration.update(pose(work["rotations"][t]))
    fk_frame_s = (time.perf_counter() - start) / frames
    np.savez(sys.argv[2], rotations=made)
    note = f"{ITERATIONS} QPs per frame ({solver}), {len(rows)} of {len(work['first'])} capsule pairs"
    note += f", {infeasible} QPs without a solution" if infeasible else ""
    version = importlib.metadata.version("mink")
    print(json.dumps({"version": version, "frame_s": frame_s, "fk_frame_s": fk_frame_s, "note": note}))


if __name__ == "__main__":
    main()

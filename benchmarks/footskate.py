"""What footskate removal achieves, per method, on clips and on bodies with shorter, longer and thicker legs.

    python -m benchmarks.footskate --data FOLDER [--every | --clips bvh/02_01_walk ...] [--methods root leg-ik adaptive]
    python -m benchmarks.footskate --data FOLDER [--every] --time

FOLDER holds bvh/*.bvh, locomotion/*.bvh and characters/*.glb; `--every` takes all of locomotion. Legs of 0.7 to 1.4 times
the length come twice: with the root path scaled along (as `onto` does) and as it was, which skates the most. Prints per
method and body, over all clips: the slide of the planted vertex (worst in a frame, and 95th percentile, before and
after), the acceleration ratio, a knee's greatest angular acceleration over the clip's, the deepest penetration, and the CPU
time per frame; for "adaptive" how far held ankles and toes are from their goals, and by how much the greatest change of a
foot's velocity from one frame to the next grew, over the clip's greatest velocity.

For "root" also how far the way's direction turns and how long it is: over that of the same clip on the body as it is,
over the legs' length from the hip to the floor (the foot under a longer shank stays as it is). Counted are all clips
that go further than a metre. Those off by more than 5 % or 5 degrees are listed, with what comes out when every body
stands where the body as it is does: limbs that do not turn and feet that do not slide leave nothing to choose then. So
a pelvis that turns over the feet adds to the way what its own width asks for, which longer legs do not change.

`--time` prints the CPU time per frame of labels and methods on the body as it is (fastest of some runs: what the machine
does besides is not theirs), what the first call in a process takes, and how time grows with the frames of a clip.
"""

import argparse
import pathlib
import subprocess
import sys
import time

import numpy as np

import motionfit as mf
from motionfit._motion import bind_pose, host_kinematics
from motionfit.feet import METHODS, FootFit
from motionfit.feet._classics import foot_joints
from motionfit.metrics import derivative_ratio
from motionfit.shape.growth import grow
from tests.helpers import knee_accelerations, with_legs

CLIPS = (
    "bvh/02_01_walk", "bvh/05_01_slow_walk", "bvh/16_21_fast_walk", "bvh/16_36_run", "bvh/16_42_run_90deg_left_turn",
    "bvh/16_01_jump", "bvh/16_05_forward_jump", "bvh/131_03_start_hop_stop", "bvh/05_02_dance_arms_pirouette",
    "bvh/05_03_dance_folding_arms", "bvh/05_11_sideways_steps_pirouette", "locomotion/walk_16_11",
    "locomotion/walk_16_47", "locomotion/walk_09_12", "locomotion/run_09_01", "locomotion/run_127_03",
)  # fmt: skip
LEGS = (0.7, 0.85, 1.2, 1.4)
FAR = 1.0  # [m] a clip that does not get further has no way to measure
WITHIN, STRAIGHT = 0.05, 5.0  # of the way's length, and [deg] of its direction
REPEATS = 5


def way(motion: mf.Motion) -> np.ndarray:
    root = np.asarray(motion.root, float)
    return (root[-1] - root[0])[[0, 2]]


def leg(body: mf.Character) -> float:
    """Height of the hip joint over the sole [m] in the bind pose."""
    hip = bind_pose(body.skeleton)[0][body.skeleton.joint("left_thigh"), 1]
    return float(hip - np.asarray(body.skin.vertices_bind)[:, 1].min())


def turned(motion: mf.Motion, source: mf.Motion) -> float:
    """The angle [deg] between the ways of two motions."""
    return float(abs(np.degrees(np.angle((way(motion) @ [1, 1j]) / (way(source) @ [1, 1j])))))


def feet_speeds(motion: mf.Motion) -> np.ndarray:
    """First differences [m] of ankles and toes, (frames - 1, joints, 3)."""
    joints = [joint for foot in foot_joints(motion.skeleton) for joint in foot]
    return np.diff(host_kinematics(motion, joints)[0][:, joints], axis=0)


def jump(motion: mf.Motion, source: mf.Motion) -> float:
    """By how much a foot's greatest change of velocity in a frame grew, over its greatest velocity in the source."""
    now, before = (float(np.linalg.norm(np.diff(feet_speeds(m), axis=0), axis=-1).max()) for m in (motion, source))
    return (now - before) / float(np.linalg.norm(feet_speeds(source), axis=-1).max())


def measure(motion: mf.Motion, body: mf.Character, method: str) -> tuple[FootFit, dict[str, float]]:
    """One clip on one body."""
    mf.remove_footskate(motion, body, method)
    started = time.process_time()
    fit = mf.remove_footskate(motion, body, method)
    seconds = time.process_time() - started
    before, after = fit.measure(fit.base), fit.measure(fit.motion)
    row = {
        "slide p95 before [mm/s]": 1e3 * (before["slide_p95_m_s"] or 0.0),
        "p95 after": 1e3 * (after["slide_p95_m_s"] or 0.0),
        "worst frame [mm]": 1e3 * (after["slide_max_m_s"] or 0.0) * float(motion.dt),
        "acceleration": derivative_ratio(fit.motion, fit.base, 2) or np.nan,
        "knee peak": float((knee_accelerations(fit.motion).max(1) / knee_accelerations(fit.base).max(1)).max()),
        "penetration [cm]": 100 * after["ground_penetration_max_m"],
        "CPU [us/frame]": 1e6 * seconds / motion.frame_count,
        "same rotations": float(fit.motion.rotations is fit.base.rotations),
        "unreachable": float((~fit.reachable).any(1).sum()),
    }
    if method == "adaptive":
        row |= {
            "ankle off [mm]": 1e3 * fit.details["ankle_error_max_m"],
            "toe off [mm]": 1e3 * fit.details["toe_error_max_m"],
            "velocity jump [%]": 100 * jump(fit.motion, fit.base),
        }
    return fit, row


def table_of(method: str, bodies: list, clips: dict[str, mf.Motion]) -> None:
    """One row per body, and what is over the bounds of single pairs of clip and body."""
    reference = bodies[0][1]
    own: dict[str, FootFit] = {}
    over: list[str] = []
    knees, pairs, far = 0, 0, 0
    for label, body, raw in bodies:
        rows, ratios, angles = {}, [], []
        for name, clip in clips.items():
            motion = mf.onto(clip, body.skeleton)
            if raw:
                motion = mf.Motion(body.skeleton, clip.root, clip.rotations, clip.dt)
            fit, rows[name] = measure(motion, body, method)
            first = own.setdefault(name, fit)
            pairs += 1
            knees += rows[name]["knee peak"] > 1.2
            if method != "root" or np.linalg.norm(way(first.base)) < FAR:
                continue
            far += 1
            expected = np.linalg.norm(way(first.motion)) * leg(body) / leg(reference)
            ratios.append(np.linalg.norm(way(fit.motion)) / expected)
            angles.append(turned(fit.motion, fit.base))
            if abs(ratios[-1] - 1) > WITHIN or angles[-1] > STRAIGHT:
                held = mf.remove_footskate(motion, body, method, plants=first.plants).motion
                over.append(f"{name}, {label}{', path as it was' if raw else ''}: {ratios[-1]:.3f}, {angles[-1]:.1f} deg; "
                            f"on the plants of the body as it is {np.linalg.norm(way(held)) / expected:.3f}, "
                            f"{turned(held, fit.base):.1f} deg")  # fmt: skip
        keys = list(next(iter(rows.values())))
        if body is reference:
            more = ["way over legs", "turned [deg]"] if method == "root" else []
            print(f"\n{method}\n| body | " + " | ".join(keys + more) + " |\n" + "|---" * (1 + len(keys + more)) + "|")
        cells = []
        for key in keys:
            values = np.array([row[key] for row in rows.values()])
            middle = key in ("acceleration", "CPU [us/frame]", "slide p95 before [mm/s]")
            whole = np.nanmin if key == "same rotations" else np.nanmedian if middle else np.nanmax
            cells.append(f"{whole(values):.3g}")
        if ratios:
            cells += [f"{min(ratios):.3f} to {max(ratios):.3f}", f"{max(angles):.1f}"]
        print(f"| {label}{', path as it was' if raw else ''} | " + " | ".join(cells) + " |", flush=True)
    print(f"knee peak over 1.2: {knees} of {pairs}")
    if far:
        print(f"way off by more than {WITHIN:.0%} or {STRAIGHT:g} deg: {len(over)} of {far}", *over, sep="\n  ")


def times_of(body: mf.Character, clips: dict[str, mf.Motion], arguments: list[str]) -> None:
    """CPU time per frame, of the first call, and over the length of a clip."""
    works = {"labels": mf.detect_footplants} | {
        method: (lambda motion, body, method=method: mf.remove_footskate(motion, body, method)) for method in METHODS
    }

    def seconds(work, motion: mf.Motion) -> float:
        taken = []
        for _ in range(1 + REPEATS):
            started = time.process_time()
            work(motion, body)
            taken.append(time.process_time() - started)
        return min(taken[1:])

    print(
        "| | median [us/frame] | worst | of | first call [s] | time over frames, to the power of |\n" + "|---" * 6 + "|"
    )
    longest = max(clips.values(), key=lambda clip: clip.frame_count)
    for name, work in works.items():
        per_frame = {clip: 1e6 * seconds(work, motion) / motion.frame_count for clip, motion in clips.items()}
        worst = max(per_frame, key=lambda clip: per_frame[clip])
        # there and back again, so that no frame jumps
        swing = np.append(np.arange(longest.frame_count), np.arange(longest.frame_count - 1)[::-1])
        lengths = [longest[np.tile(swing, k)] for k in (1, 2, 4)]
        taken = [seconds(work, motion) for motion in lengths]
        power = np.polyfit(np.log([m.frame_count for m in lengths]), np.log(taken), 1)[0]
        first = subprocess.run([sys.executable, "-m", "benchmarks.footskate", *arguments, "--first", name],
                               capture_output=True, text=True, check=True).stdout.strip()  # fmt: skip
        print(f"| {name} | {np.median(list(per_frame.values())):.1f} | {per_frame[worst]:.1f} | {worst}, "
              f"{clips[worst].frame_count} frames | {first} | {power:.2f} |", flush=True)  # fmt: skip


def first_call(name: str, body: mf.Character, motion: mf.Motion) -> None:
    """Wall time [s] of the first call in this process."""
    started = time.perf_counter()
    if name == "labels":
        mf.detect_footplants(motion, body)
    else:
        mf.remove_footskate(motion, body, name)
    print(f"{time.perf_counter() - started:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=pathlib.Path, required=True)
    parser.add_argument("--clips", nargs="*", default=CLIPS)
    parser.add_argument(
        "--every", action="store_true", help="of bvh the clips that go somewhere, and all of locomotion"
    )
    parser.add_argument("--methods", nargs="*", default=METHODS)
    parser.add_argument("--body", default="avg_male")
    parser.add_argument("--time", action="store_true")
    parser.add_argument("--first", help=argparse.SUPPRESS)
    options = parser.parse_args()
    body = mf.load_character(options.data / f"characters/{options.body}.glb")
    names = options.clips
    if options.every:
        names = [name for name in CLIPS if name.startswith("bvh")]
        names += sorted(f"locomotion/{path.stem}" for path in (options.data / "locomotion").glob("*.bvh"))
    if options.first:
        return first_call(options.first, body, mf.onto(mf.load_motion(options.data / f"{names[0]}.bvh"), body.skeleton))
    clips = {name: mf.onto(mf.load_motion(options.data / f"{name}.bvh"), body.skeleton) for name in names}
    if options.time:
        return times_of(body, clips, ["--data", str(options.data), "--body", options.body, "--clips", names[0]])
    bodies: list[tuple[str, mf.Character, bool]] = [("as it is", body, False)]
    bodies += [(f"legs {k:g}", with_legs(body, k), raw) for k in LEGS for raw in (False, True)]
    bodies += [("girth 1.6", grow(body, dict.fromkeys(("arms", "legs", "trunk"), 1.6)), False)]
    for method in options.methods:
        table_of(method, bodies, clips)


if __name__ == "__main__":
    main()

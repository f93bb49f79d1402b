"""What footskate removal achieves, per method, on clips and on bodies with shorter, longer and thicker legs.

    python -m benchmarks.footskate --data FOLDER [--clips bvh/02_01_walk ...] [--methods root leg-ik adaptive]

FOLDER holds bvh/*.bvh, locomotion/*.bvh and characters/*.glb. Legs of 0.7 to 1.4 times the length come twice: with the
root path scaled along (as `onto` does) and as it was, which skates the most. Prints per method and body, over all
clips: the slide of the planted vertex (worst in a frame, and 95th percentile, before and after), how far the way's
direction turns at worst (of clips that go further than a metre), its length over that of the same clip on the body
as it is, over the legs' length from the hip to the floor (the foot under a longer shank stays as it is), the
acceleration ratio, a knee's greatest angular acceleration over the clip's, the deepest penetration, and the CPU time
per frame.
"""

import argparse
import pathlib
import time

import numpy as np

import motionfit as mf
from motionfit._motion import bind_pose
from motionfit.feet import METHODS
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


def way(motion: mf.Motion) -> np.ndarray:
    root = np.asarray(motion.root, float)
    return (root[-1] - root[0])[[0, 2]]


def leg(body: mf.Character) -> float:
    """Height of the hip joint over the sole [m] in the bind pose."""
    hip = bind_pose(body.skeleton)[0][body.skeleton.joint("left_thigh"), 1]
    return float(hip - np.asarray(body.skin.vertices_bind)[:, 1].min())


def measure(motion: mf.Motion, body: mf.Character, method: str) -> dict[str, float]:
    """One clip on one body."""
    mf.remove_footskate(motion, body, method)
    started = time.process_time()
    fit = mf.remove_footskate(motion, body, method)
    seconds = time.process_time() - started
    before, after = fit.measure(fit.base), fit.measure(fit.motion)
    source, now = way(fit.base), way(fit.motion)
    turned = np.nan
    if np.linalg.norm(source) > 1.0:
        turned = abs(np.degrees(np.angle((now @ [1, 1j]) / (source @ [1, 1j]))))
    return {
        "slide p95 before [mm/s]": 1e3 * (before["slide_p95_m_s"] or 0.0),
        "p95 after": 1e3 * (after["slide_p95_m_s"] or 0.0),
        "worst frame [mm]": 1e3 * (after["slide_max_m_s"] or 0.0) * float(motion.dt),
        "turned [deg]": float(turned),
        "way [m]": float(np.linalg.norm(now)),
        "acceleration": derivative_ratio(fit.motion, fit.base, 2) or np.nan,
        "knee peak": float((knee_accelerations(fit.motion).max(1) / knee_accelerations(fit.base).max(1)).max()),
        "penetration [cm]": 100 * after["ground_penetration_max_m"],
        "CPU [us/frame]": 1e6 * seconds / motion.frame_count,
        "same rotations": float(fit.motion.rotations is fit.base.rotations),
        "unreachable": float((~fit.reachable).any(1).sum()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=pathlib.Path, required=True)
    parser.add_argument("--clips", nargs="*", default=CLIPS)
    parser.add_argument("--methods", nargs="*", default=METHODS)
    parser.add_argument("--body", default="avg_male")
    options = parser.parse_args()
    body = mf.load_character(options.data / f"characters/{options.body}.glb")
    clips = {name: mf.onto(mf.load_motion(options.data / f"{name}.bvh"), body.skeleton) for name in options.clips}
    bodies: list[tuple[str, mf.Character, bool]] = [("as it is", body, False)]
    bodies += [(f"legs {k:g}", with_legs(body, k), raw) for k in LEGS for raw in (False, True)]
    bodies += [("girth 1.6", grow(body, dict.fromkeys(("arms", "legs", "trunk"), 1.6)), False)]
    for method in options.methods:
        own: dict[str, float] = {}
        for number, (label, character, raw) in enumerate(bodies):
            rows = {}
            for name, clip in clips.items():
                motion = mf.onto(clip, character.skeleton)
                if raw:
                    motion = mf.Motion(character.skeleton, clip.root, clip.rotations, clip.dt)
                rows[name] = measure(motion, character, method)
            if number == 0:
                own = {name: row["way [m]"] for name, row in rows.items()}
                keys = [k for k in next(iter(rows.values())) if k != "way [m]"]
                print(f"\n{method}\n| body | " + " | ".join(keys) + " | way over legs |")
                print("|---" * (len(keys) + 2) + "|")
            legs = leg(character) / leg(body)
            ratios = [row["way [m]"] / own[name] / legs for name, row in rows.items() if own[name] > 1.0]
            cells = []
            for key in keys:
                values = np.array([row[key] for row in rows.values()])
                middle = key in ("acceleration", "CPU [us/frame]", "slide p95 before [mm/s]")
                whole = np.nanmin if key == "same rotations" else np.nanmedian if middle else np.nanmax
                cells.append(f"{whole(values):.3g}")
            print(f"| {label}{', path as it was' if raw else ''} | " + " | ".join(cells)
                  + f" | {min(ratios):.3f} to {max(ratios):.3f} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()

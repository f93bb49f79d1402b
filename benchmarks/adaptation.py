"""What adaptation achieves on real clips and bodies, before and after, on volumes and skin, and against an artist's
constant offset.

    python -m benchmarks.adaptation --data FOLDER [--clips bvh/02_01_walk ...] [--bodies heavy_male ...]

FOLDER holds bvh/*.bvh, locomotion/*.bvh and characters/*.glb. Without one, the built-in sample is used. Prints one
row per clip and body.
"""

import argparse
import pathlib
import time
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

import motionfit as mf
from motionfit import samples
from motionfit._motion import Motion, joint_angles
from motionfit.adapt import build_clearance, volume_depths
from motionfit.metrics import derivative_ratio, skin_depths
from motionfit.shape.growth import grow
from motionfit.shape.pairs import pairs_of

CLIPS = ("bvh/02_01_walk", "bvh/05_01_slow_walk", "bvh/16_21_fast_walk", "bvh/16_36_run", "locomotion/walk_16_15")
BODIES = ("heavy_male", "tall_male", "athletic_female", "short_female", "avg_male*1.3", "avg_male*1.6")


def constant_offset(fit: mf.Fit, character: mf.Character, own: np.ndarray, at: np.ndarray, aim: np.ndarray) -> Motion:
    """The smallest constant turn per driven joint that leaves no more excess on volumes and skin than the fit does.

    What an artist does with an arm-space slider: one rotation vector per shoulder and one opposite angle for the
    thighs, in the joint's parent's frame, the same in every frame. The axis is the best of nine around the mean
    of the fit's own axes, by the volumes; its angle then grows until the skin at the frames `at` shows no more than
    `aim` [m] per pair over the reference's `own`.
    """
    frames = fit.details["frames"]
    seen, rotations = fit.base[frames], np.array(fit.base.rotations, float)
    for block, names in (("arms", ("left_arm", "right_arm")), ("legs", ("thighs_apart",))):
        used = [c for c in fit.correction.controls if c.name in names]
        if not used:
            continue
        clearance = build_clearance(character, pairs_of(block))
        columns = [fit.details["pairs"].index(p.name) for p in clearance.pairs]
        limit = volume_depths(clearance, seen) - fit.details["excess_before_m"][:, columns]
        left = np.maximum(fit.details["excess_after_m"][:, columns], 0.0).max(0) + 1e-4
        for control in used:
            side = control.name.partition("_")[0]
            mine = [k for k, p in enumerate(clearance.pairs) if block == "legs" or p.first.startswith(side)]

            def turned(angle: float, tilt: Rotation, rotations: np.ndarray, control=control) -> np.ndarray:
                result = np.array(rotations, float)
                for drive in control.drives:
                    axis = np.mean(np.asarray(drive.axis_parent, float).reshape(-1, 3), axis=0)
                    axis = tilt.apply(axis / np.linalg.norm(axis)) * float(drive.gain)
                    own = Rotation.from_quat(result[:, drive.joint], scalar_first=True)
                    result[:, drive.joint] = (Rotation.from_rotvec(angle * axis) * own).as_quat(scalar_first=True)
                return result

            def enough(angle: float, tilt: Rotation, clearance=clearance, mine=mine, limit=limit, left=left,
                       turned=turned) -> bool:  # fmt: skip
                moved = Motion(seen.skeleton, seen.root, turned(angle, tilt, np.asarray(seen.rotations)), seen.dt)
                excess = volume_depths(clearance, moved) - limit
                return bool((excess[:, mine].max(0) <= left[mine]).all())

            best, chosen = 1.2, None
            tilts = [(0, 0), *((a, b) for a in (-0.4, 0, 0.4) for b in (-0.4, 0, 0.4) if (a, b) != (0, 0))]
            for a, b in tilts if block == "arms" else tilts[:1]:
                tilt = Rotation.from_rotvec([0.0, a, b])
                # from below: an arm that is far out may come upon something else
                tried = (angle for angle in (0.0, *np.arange(0.05, 1.2, 0.05)) if angle < best)
                high = next((angle for angle in tried if enough(angle, tilt)), None)
                if high is None:
                    continue
                low = max(high - 0.05, 0.0)
                for _ in range(5 if high else 0):
                    middle = (low + high) / 2
                    low, high = (low, middle) if enough(middle, tilt) else (middle, high)
                best, chosen = high, tilt
            tilt = chosen or Rotation.identity()
            pairs = tuple(clearance.pairs[k] for k in mine)
            places = [mf.shape.PAIRS.index(p) for p in pairs]

            def clean(angle: float, tilt=tilt, pairs=pairs, places=places, turned=turned) -> bool:
                some = fit.base[at]
                moved = Motion(some.skeleton, some.root, turned(angle, tilt, np.asarray(some.rotations)), some.dt)
                depths = skin_depths(character, moved, pairs).depth - own[:, places]
                return bool((depths.max(0) <= np.maximum(aim[places], 0.0) + 1e-3).all())

            # what no turn about this axis can clean keeps the angle that the volumes ask for
            wider = [best, *(best + step for step in np.arange(0.03, 0.4, 0.03))]
            best = next((angle for angle in wider if clean(angle)), best)
            rotations = turned(best, tilt, rotations)
    return Motion(fit.base.skeleton, fit.base.root, rotations, fit.base.dt)


def row(
    clip: Motion, character: mf.Character, reference: mf.Character, blocks: Sequence[str], objective: str, frames: int,
    offset: bool,
) -> dict:  # fmt: skip
    """One clip on one body: shares of frames over 1 cm, inside ratios, deviations and smoothness."""
    started = time.perf_counter()
    fit = mf.adapt(clip, character, reference=reference, blocks=blocks, objective=objective)
    seconds = time.perf_counter() - started
    step = max(1, fit.base.frame_count // frames)
    own = skin_depths(reference, mf.onto(clip, reference.skeleton), step=step)
    before, after = (skin_depths(character, m, step=step) for m in (fit.base, fit.motion))

    def over(depths):
        return float(((depths.depth - own.depth) > 0.01).any(1).mean())

    volumes = [np.asarray(fit.details[f"excess_{k}_m"]) for k in ("before", "after")]
    result = {
        "volumes_before": float((volumes[0] > 0.01).any(1).mean()),
        "volumes_after": float((volumes[1] > 0.01).any(1).mean()),
        "skin_before": over(before), "skin_after": over(after),
        "worst_before_m": float((before.depth - own.depth).max()), "worst_after_m": float((after.depth - own.depth).max()),
        "inside_reference": own.inside_ratio, "inside_before": before.inside_ratio, "inside_after": after.inside_ratio,
        "jerk_ratio": derivative_ratio(fit.motion, fit.base, 3),
        "deviation_rad": float(joint_angles(fit.motion, fit.base).mean()), "seconds": seconds,
    }  # fmt: skip
    if offset:
        # every third of the frames looked at: each costs a look at the skin per try
        still = constant_offset(fit, character, own.depth[::3], own.frames[::3], (after.depth - own.depth)[::3].max(0))
        result["deviation_constant_rad"] = float(joint_angles(still, fit.base).mean())
    worst = (after.depth - own.depth).max(0)
    result["worst_pair"] = mf.shape.PAIRS[int(worst.argmax())].name
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=pathlib.Path)
    parser.add_argument("--clips", nargs="*", default=CLIPS)
    parser.add_argument("--bodies", nargs="*", default=BODIES)
    parser.add_argument("--reference", default="avg_male")
    parser.add_argument("--frames", type=int, default=80, help="frames looked at on the skin, per clip")
    parser.add_argument(
        "--blocks", default=",".join(mf.adapt.DEFAULT), help="an offset does the work of arms,legs only"
    )
    parser.add_argument("--objective", default="vertex", help="as in `mf.adapt`")
    parser.add_argument("--offset", action="store_true", help="compare with the best constant offset")
    options = parser.parse_args()
    keys: list[str] = []
    clips = options.clips if options.data else ("builtin:walk",)
    for name in clips:
        clip = mf.load_motion(options.data / f"{name}.bvh") if options.data else samples.walk()
        for body in options.bodies if options.data else ("heavy", "child", "average*1.3"):
            stem, _, scale = body.partition("*")
            reference = mf.load_character(
                options.data / f"characters/{options.reference}.glb" if options.data else "builtin:average"
            )
            character = mf.load_character(
                options.data / f"characters/{stem}.glb" if options.data else f"builtin:{stem}"
            )
            if scale:
                reference = character
                character = grow(character, dict.fromkeys(("arms", "legs", "trunk"), float(scale)))
            found = row(clip, character, reference, options.blocks.split(","), options.objective, options.frames,
                        options.offset)  # fmt: skip
            if not keys:
                keys = list(found)
                print("| clip | body | " + " | ".join(keys) + " |")
                print("|---" * (len(keys) + 2) + "|")
            cells = [v if isinstance(v, str) else f"{v:.4g}" for v in (found[k] for k in keys)]
            print(f"| {name} | {body} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()

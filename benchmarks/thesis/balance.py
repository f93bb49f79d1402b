"""Table 5.6 and figure 5.19: how far the zero-moment point is from its support, for the original, corrected and balanced
clips.

python -m benchmarks.thesis.balance [--data FOLDER] [--bodies NAME ...] [--clips KIND ...] [--out DIR]

Original is the clip on the body that it was made for, corrected that with arms and legs adapted to the other body,
balanced the same with the balance block. Measured at the clip's own frame rate, with the masses of the cut mesh. Beside
it: how far the feet were moved by the block while planted, the jerk's ratio to the corrected clip's, and the share of
the frames with more than 1 cm of excess on the skin, corrected and balanced.
"""

import numpy as np

import motionfit as mf
from benchmarks.thesis import _printed as printed
from benchmarks.thesis._setting import arguments, bodies, clips, kinematics, save_figure, table
from motionfit._motion import host_kinematics
from motionfit.balance import ZmpDistance, balance_measures, sole_boxes, zmp_distance
from motionfit.metrics import derivative_ratio, skin_depths
from motionfit.shape.mass import mesh_masses

SKIN_LOOKS = 40  # per clip
STAGES = {"original": "k", "corrected": "tab:red", "balanced": "tab:green"}


def distance(character: mf.Character, motion: mf.Motion, planted: np.ndarray) -> ZmpDistance:
    floor = mf.detect_footplants(motion, character).floor
    return zmp_distance(kinematics(character.skeleton, motion), mesh_masses(character), sole_boxes(character), planted,
                        ground=floor.at(np.asarray(motion.root, float)))  # fmt: skip


def draw(axes, found: list[ZmpDistance], dt: float) -> None:
    """Figure 5.19: the distances of one clip over time, with gaps where nothing carries."""
    for one, (name, colour) in zip(found, STAGES.items(), strict=True):
        outside = np.where(one.supported, 100 * np.asarray(one.outside), np.nan)
        axes.plot(dt * np.arange(len(outside)), outside, color=colour, label=name)
    axes.set(xlabel="time [s]", ylabel="distance from the support [cm]")
    axes.legend()


def main() -> None:
    options = arguments(__doc__ or "")
    motions, rows = clips(options), []
    reference = mf.load_character(options.data / "characters/avg_male.glb" if options.data else "builtin:average")
    for body, character in bodies(options).items():
        if body == reference.name:
            continue
        for name, clip in motions.items():
            own = mf.onto(clip, reference.skeleton)
            planted = np.asarray(mf.detect_footplants(own, reference).planted)
            corrected = mf.adapt(clip, character, reference=reference, blocks=("arms", "legs"))
            balanced = mf.adapt.balance(clip, character, corrected, reference=reference)
            found = [distance(reference, own, planted), *(distance(character, f.motion, planted) for f in
                                                          (corrected, balanced))]  # fmt: skip
            feet = [[character.skeleton.joint(f"{s}_{r}") for r in ("foot", "toe")] for s in ("left", "right")]
            places = [host_kinematics(f.motion)[0] for f in (corrected, balanced)]
            moved = max(
                float(np.abs((places[1] - places[0])[planted[:, k]][:, feet[k]]).max(initial=0.0)) for k in (0, 1)
            )
            step = max(1, clip.frame_count // SKIN_LOOKS)
            skin = skin_depths(reference, own, step=step).depth
            over = [float((skin_depths(character, f.motion, step=step).depth - skin > 0.01).any(1).mean())
                    for f in (corrected, balanced)]  # fmt: skip
            cells = [
                f"{100 * (m['zmp_distance_mean_m'] or 0):.2f} ({100 * (m['zmp_distance_sd_m'] or 0):.2f})"
                for m in map(balance_measures, found)
            ]
            if name == "Normal walk":
                save_figure(options.out / f"figure_5_19_{body}.png", f"Figure 5.19: the walk on {body}",
                            lambda axes, found=found, dt=float(clip.dt): draw(axes, found, dt))  # fmt: skip
            jerk = derivative_ratio(balanced.motion, corrected.motion, 3)
            rows.append([name, body, *cells, f"{1e3 * moved:.3f}", f"{jerk:.3f}", *(f"{100 * o:.0f}" for o in over),
                         balanced.status])  # fmt: skip
            print(" | ".join(rows[-1]), flush=True)
    rows += [[k, "thesis", *cells, "-", "-", "-", "-", "-"] for k, cells in printed.BALANCED.items()]
    table("Table 5.6: distance of the ZMP from its support [cm] (SD)",
          ["motion", "body", "original", "corrected", "balanced", "feet [mm]", "jerk", "skin %", "after", "status"],
          rows, options.out, "table_5_6")  # fmt: skip


if __name__ == "__main__":
    main()

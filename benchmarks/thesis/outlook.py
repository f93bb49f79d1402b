"""What the thesis leaves open (5.5.2, 6.2), before and after: touches that were meant, forearms, feet, strength.

python -m benchmarks.thesis.outlook [--data FOLDER] [--bodies NAME ...] [--clips KIND ...] [--seconds S] [--out DIR]

A clip made for avg_male on another body: as it comes, with arms and legs adapted, and with all blocks of
`motionfit.adapt`. Per clip and body, for these three where it says so:

- skin: share of the frames with more than 1 cm of excess on the skin, before and after all blocks;
- kept: of the frames in which a hand touches torso, thighs, head or the other arm on its own body (within 5 mm on the
  skin), the share in which it is within 2 cm of that part's surface, per part; with arms and legs and with all blocks;
- forearm: mean angle [degrees] between the forearms' directions and those of the clip, with arms and legs and with all;
- slide: how far planted feet slide [cm], as it comes, with arms and legs, and with all;
- strain: the most frames [%] in which a joint needs more than a strong man's or woman's torque (`motionfit.dynamics`),
  of the clip on its own body, as it comes on the other, and with all.

Where control points lie, open too, is `benchmarks.thesis.knots`.
"""

import time

import numpy as np

import motionfit as mf
from benchmarks.thesis._setting import argument_parser, kinematics, table
from motionfit import samples
from motionfit._motion import Motion
from motionfit.adapt import measure_standing, source_stance
from motionfit.balance import sole_boxes
from motionfit.dynamics import feasibility
from motionfit.metrics import TOLERANCE, forearm_direction, skin_depths, skin_gaps
from motionfit.shape.mass import mesh_masses
from motionfit.shape.pairs import Pair

KINDS: dict[str, str] = {
    "hands on hip": "bvh/29_03_teapot_hand_on_hip", "arms crossing": "bvh/02_10_wash_self_arms_crossing",
    "folding arms": "bvh/05_03_dance_folding_arms", "two hands": "bvh/64_01_golf_swing_two_hands", "walk": "bvh/02_01_walk",
}  # fmt: skip
OTHER = {"left": "right", "right": "left"}
TOUCHES = tuple(Pair(f"{s}_hand", part, "") for s, o in OTHER.items() for part in
                ("torso", "left_thigh", "right_thigh", "head", f"{o}_upper_arm", f"{o}_forearm", f"{o}_hand"))  # fmt: skip
TOUCHED, KEPT = 0.005, 0.02  # [m]
SKIN_LOOKS = 40
COLUMNS = ["clip", "body", "status", "skin %", "all", "worst [cm]",
           "forearm [deg]", "all", "slide [cm]", "arms+legs", "all", "strain % own", "before", "all", "time [s]"]  # fmt: skip
KEPT_COLUMNS = ["clip", "body", "touch", "frames", "kept % arms+legs", "all"]


def strain(character: mf.Character, motion: Motion) -> float:
    """The most frames [%] over a limit, of any action."""
    plants = mf.detect_footplants(motion, character)
    ground = float(np.mean(plants.floor.at(np.asarray(motion.root, float))))
    found = feasibility(
        character.skeleton, kinematics(character.skeleton, motion), mesh_masses(character), sole_boxes(character),
        np.asarray(plants.planted), float(np.ptp(np.asarray(character.skin.vertices_bind)[:, 1])),
        sex="female" if "female" in character.name else "male", ground=ground,
    )  # fmt: skip
    return 100.0 * max(found.exceeded.values())


def kept(own: np.ndarray, *gaps: np.ndarray) -> list[list[str]]:
    """Per touched part, how many frames touch, and the share of them in which the hand is still near, by `gaps`."""
    told = []
    for k, pair in enumerate(TOUCHES):
        touched = own[:, k] < TOUCHED
        if touched.any():
            shares = (f"{100 * float((gap[touched, k] <= KEPT).mean()):.0f}" for gap in gaps)
            told.append([pair.name, str(int(touched.sum())), *shares])
    return told


def row(clip: Motion, character: mf.Character, reference: mf.Character) -> tuple[list[str], list[list[str]]]:
    """One clip on one body, in the order of `COLUMNS` from the status on, and of `KEPT_COLUMNS` from the touch on."""
    original, base = mf.onto(clip, reference.skeleton), mf.onto(clip, character.skeleton)
    started = time.perf_counter()
    limbs = mf.adapt(clip, character, reference=reference, blocks=("arms", "legs"))
    fit = mf.adapt(clip, character, reference=reference, blocks=mf.adapt.BLOCKS)
    seconds = time.perf_counter() - started
    at = np.arange(0, clip.frame_count, max(1, clip.frame_count // SKIN_LOOKS))
    own = skin_depths(reference, original[at]).depth
    before, after = (skin_depths(character, m[at]).depth - own for m in (base, fit.motion))
    touching = skin_gaps(reference, original[at], TOUCHES)
    stance = source_stance(character, base, reference, original)
    slides = [measure_standing(character, m, stance)["feet"] or {} for m in (base, limbs.motion, fit.motion)]
    shares = [100 * float((depth > TOLERANCE).any(1).mean()) for depth in (before, after)]
    touches = kept(touching, *(skin_gaps(character, m[at], TOUCHES) for m in (limbs.motion, fit.motion)))
    return [
        fit.status, *(f"{s:.0f}" for s in shares), f"{100 * after.max():.1f}",
        *(f"{np.rad2deg(forearm_direction(m, base) or 0.0):.1f}" for m in (limbs.motion, fit.motion)),
        *(f"{100 * s['slide_path_m']:.1f}" if s.get("slide_path_m") is not None else "-" for s in slides),
        *(f"{strain(c, m):.0f}" for c, m in ((reference, original), (character, base), (character, fit.motion))),
        f"{seconds:.0f}",
    ], touches  # fmt: skip


def main() -> None:
    parser = argument_parser(__doc__ or "", clips=False)
    parser.add_argument("--clips", nargs="*", choices=KINDS, default=list(KINDS), metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--seconds", type=float, default=4.0, help="of each clip, from its beginning")
    options = parser.parse_args()
    data, rows = options.data, []
    touches: list[list[str]] = []
    reference = mf.load_character(data / "characters/avg_male.glb" if data else "builtin:average")
    for body in options.bodies or (["heavy_male"] if data else ["heavy"]):
        character = mf.load_character(data / f"characters/{body}.glb" if data else f"builtin:{body}")
        for kind in options.clips if data else ("walk",):
            clip = mf.load_motion(data / f"{KINDS[kind]}.bvh") if data else samples.walk(cycles=1)
            clip = clip[: max(1, round(options.seconds * clip.frame_rate))]
            measured, still = row(clip, character, reference)
            rows.append([kind, body, *measured])
            touches += [[kind, body, *touch] for touch in still]
            print(" | ".join([*rows[-1], *(f"{t[0]} {t[2]} -> {t[3]} % of {t[1]}" for t in still)]), flush=True)
    table("What the thesis leaves open", COLUMNS, rows, options.out, "outlook")
    table("Touches kept", KEPT_COLUMNS, touches, options.out, "touches")


if __name__ == "__main__":
    main()

"""The whole procedure of thesis 5.2 on clips of every kind and bodies of every build: status and figures in one table.

python -m benchmarks.thesis.pipeline [--data FOLDER] [--bodies NAME ...] [--clips KIND ...] [--seconds S] [--resume]

`motionfit.adapt` with its own blocks, for a clip made for avg_male. Per clip and body: the share of the frames with
more than 1 cm of excess on the skin, before and after, the worst excess left [cm], the jerk's ratio to that of the clip,
how far the carrying feet slide [cm], before and after, the mean distance of the zero-moment point from its support [cm]
(SD), of the original on its own body, before the balance block and after it, the mean change of the joints [degrees], and
the time [s]. A body whose point is nearer than the original's before that block is left as it is. The thesis's figures
are those of table 5.6. Each row is written as soon as it is there; `--resume` goes on after the rows of a run that was cut.
A clip on a body that fails keeps its row, with the error as its status.
"""

import csv
import pathlib
import time

import numpy as np

import motionfit as mf
from benchmarks.thesis import _printed as printed
from benchmarks.thesis._setting import argument_parser, save_figure, table
from motionfit import samples
from motionfit._motion import Motion
from motionfit.adapt import measure_standing, source_stance
from motionfit.balance import balance_measures
from motionfit.metrics import TOLERANCE, derivative_ratio, joint_angle_deviation, skin_depths

KINDS: dict[str, str] = {
    "walk": "bvh/02_01_walk", "slow walk": "bvh/05_01_slow_walk", "fast walk": "bvh/16_21_fast_walk",
    "run": "bvh/16_36_run", "turn": "bvh/16_42_run_90deg_left_turn", "lean": "bvh/02_06_bend_over_scoop_up",
    "hop": "bvh/131_03_start_hop_stop", "jump": "bvh/16_01_jump", "dance": "bvh/05_02_dance_arms_pirouette",
    "hands on hip": "bvh/29_03_teapot_hand_on_hip",
}  # fmt: skip
BODIES = ("thin_male", "avg_female", "heavy_male", "tall_male")
THESIS = {"walk": "Walk", "jump": "Jump", "hop": "Skip"}
SKIN_LOOKS = 40  # per clip
COLUMNS = ["clip", "body", "status", "skin %", "after", "worst [cm]", "jerk", "slide [cm]", "after", "ZMP original [cm]",
           "corrected", "balanced", "change [deg]", "time [s]"]  # fmt: skip


def row(clip: Motion, character: mf.Character, reference: mf.Character) -> list[str]:
    """One clip on one body, in the order of `COLUMNS` from the status on."""
    started = time.perf_counter()
    try:
        fit = mf.adapt(clip, character, reference=reference)
    except Exception as error:  # the table says of every cell what came of it
        return [f"{type(error).__name__}: {error}".replace("\n", " "), *["-"] * (len(COLUMNS) - 3)]
    seconds = time.perf_counter() - started

    original, base = mf.onto(clip, reference.skeleton), mf.onto(clip, character.skeleton)
    step = max(1, clip.frame_count // SKIN_LOOKS)
    own = skin_depths(reference, original, step=step).depth
    before, after = (skin_depths(character, m, step=step).depth - own for m in (base, fit.motion))
    stance = source_stance(character, base, reference, original)
    standing = [measure_standing(character, m, stance) for m in (base, fit.motion)]
    balance = [{} if stance.reference is None else balance_measures(stance.reference), standing[1]["balance"] or {}]
    slides = [(s["feet"] or {}).get("slide_path_m") for s in standing]
    shares = [100 * float((depth > TOLERANCE).any(1).mean()) for depth in (before, after)]
    deviation = np.rad2deg(joint_angle_deviation(fit.motion, base)[0])
    figures = [*shares, 100 * after.max(), derivative_ratio(fit.motion, base, 3), deviation]
    moving = [fit.motion.root, fit.motion.rotations, *(f for f in figures if f is not None)]
    status = fit.status if all(np.isfinite(np.asarray(m, float)).all() for m in moving) else "NaN"
    corrected = (fit.details.get("balance") or {}).get("zmp_distance_before_m")
    original, balanced = (_distance(m) for m in balance)
    return [status, f"{shares[0]:.0f}", f"{shares[1]:.0f}", f"{100 * after.max():.1f}",
            "-" if figures[3] is None else f"{figures[3]:.3f}", *("-" if s is None else f"{100 * s:.1f}" for s in slides),
            original, "-" if corrected is None else f"{100 * corrected:.2f}", balanced, f"{deviation:.2f}",
            f"{seconds:.1f}"]  # fmt: skip


def _distance(measures: dict) -> str:
    """Mean and standard deviation [cm], as the thesis prints them."""
    if measures.get("zmp_distance_mean_m") is None:
        return "-"
    return f"{100 * measures['zmp_distance_mean_m']:.2f} ({100 * measures['zmp_distance_sd_m']:.2f})"


def read(path: pathlib.Path) -> list[list[str]]:
    """The rows of an earlier run, those of the thesis left out."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [r for r in csv.reader(file) if len(r) == len(COLUMNS) and r[1] != "thesis" and r[0] != COLUMNS[0]]


def write(path: pathlib.Path, rows: list[list[str]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])


def draw(axes, rows: list[list[str]]) -> None:
    """The distance of each row as a line from the original's to that after: red where it is over a millimetre more."""
    done = [r for r in rows if "-" not in (r[9], r[11])]
    for k, r in enumerate(done):
        start, end = (float(r[i].split()[0]) for i in (9, 11))
        colour = "k" if r[1] == "thesis" else "tab:blue" if end <= start + 0.1 else "tab:red"
        axes.plot([start, end], [k, k], color=colour, lw=1.2)
        axes.plot(start, k, "o", color=colour, ms=5, mfc="w")
        axes.plot(end, k, "o", color=colour, ms=4)
    axes.set_yticks(range(len(done)), [f"{r[0]}, {r[1]}" for r in done], fontsize=6)
    axes.invert_yaxis()
    axes.set_xlabel("mean distance of the ZMP from its support [cm]: original (ring), adapted (dot), thesis in black")


def main() -> None:
    parser = argument_parser(__doc__ or "", clips=False)
    parser.add_argument("--clips", nargs="*", choices=KINDS, default=list(KINDS), metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--seconds", type=float, help="of each clip, from its beginning")
    parser.add_argument("--resume", action="store_true", help="keep the rows that are there")
    options = parser.parse_args()
    data, path = options.data, options.out / "pipeline.csv"
    reference = mf.load_character(data / "characters/avg_male.glb" if data else "builtin:average")
    rows = read(path) if options.resume else []
    done = {(r[0], r[1]) for r in rows}
    for body in options.bodies or (BODIES if data else ("heavy", "slim")):
        character = mf.load_character(data / f"characters/{body}.glb" if data else f"builtin:{body}")
        for kind in options.clips if data else ("walk",):
            if (kind, body) in done:
                continue
            clip = mf.load_motion(data / f"{KINDS[kind]}.bvh") if data else samples.walk(cycles=1)
            if options.seconds:
                clip = clip[: max(1, round(options.seconds * clip.frame_rate))]
            rows.append([kind, body, *row(clip, character, reference)])
            print(" | ".join(rows[-1]), flush=True)
            write(path, rows)
    for kind, name in THESIS.items():
        rows.append([kind, "thesis", *["-"] * 7, *printed.BALANCED[name], "-", "-"])
    table("The whole adaptation", COLUMNS, rows, options.out, "pipeline")
    save_figure(options.out / "pipeline.png", "Balance of the whole adaptation", lambda axes: draw(axes, rows))


if __name__ == "__main__":
    main()

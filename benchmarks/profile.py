"""Where the time of an adaptation goes: a warm run of `motionfit.adapt` under the profiler, in a table and a picture.

python -m benchmarks.profile [--data FOLDER] [--bodies NAME ...] [--clips KIND ...] [--seconds S]

Per clip and body, in milliseconds per frame: what each block takes, and what each kind of work takes within them. Looks at
the skin are skinning, the winding numbers and distances of what may be inside (libigl), and the touches made of them;
fields are the depths of all probes outside of a solve; solves are the compiled programs and their driver. The rest is
putting clips onto bodies, kinematics and bookkeeping. Programs are compiled beforehand, and bodies are loaded anew, so
that no look is remembered. The profiler itself costs some tenth.
"""

import cProfile
import pathlib
import pstats
import time
from collections.abc import Mapping

import motionfit as mf
from benchmarks.thesis._setting import argument_parser, save_figure, table
from benchmarks.thesis.pipeline import KINDS
from motionfit import samples
from motionfit._motion import Motion

# file and function of what is told apart: blocks do not overlap, nor do the kinds of work
BLOCKS: Mapping[str, tuple[str, str]] = {
    "arms, legs": ("_limbs.py", "limbs"), "collisions": ("_collisions.py", "collisions"),
    "footskate": ("_feet.py", "footskate"), "balance": ("_balance.py", "balance"),
}  # fmt: skip
WORK: Mapping[str, tuple[str, str]] = {
    "looks: skinning": ("metrics.py", "posed_frames"), "looks: inside, how deep": ("surface.py", "find_inside"),
    "looks: touches": ("_touches.py", "touches_of"), "gaps of touches": ("surface.py", "surface_gaps"),
    "fields": ("_clearance.py", "over_time"), "solves": ("_fit.py", "fit"), "clips onto bodies": ("_onto.py", "onto"),
}  # fmt: skip


def profiled(clip: Motion, character: mf.Character, reference: mf.Character) -> tuple[float, dict[str, float]]:
    """Seconds of one adaptation in all, and of each of `BLOCKS` and `WORK`."""
    profile, named = cProfile.Profile(), {place: name for name, place in (*BLOCKS.items(), *WORK.items())}
    start = time.perf_counter()
    profile.runcall(mf.adapt, clip, character, reference=reference)
    total = time.perf_counter() - start
    spent = dict.fromkeys((*BLOCKS, *WORK), 0.0)
    for (file, _, function), figures in pstats.Stats(profile).stats.items():  # pyright: ignore[reportAttributeAccessIssue]
        name = named.get((pathlib.Path(file).name, function))
        if name is None:
            continue
        if name in BLOCKS:
            spent[name] += figures[3]
        else:  # what one kind of work asks another for is its own: a gap, whether anything is inside
            inner = [named.get((pathlib.Path(f).name, n)) for f, _, n in figures[4]]
            times = zip(inner, figures[4].values(), strict=True)
            spent[name] += sum(by[3] for caller, by in times if caller not in WORK)
    return total, spent


def main() -> None:
    parser = argument_parser(__doc__ or "", clips=False)
    parser.add_argument("--clips", nargs="*", choices=KINDS, default=["walk", "dance"], metavar="KIND",
                        help=", ".join(KINDS))  # fmt: skip
    parser.add_argument("--seconds", type=float, default=4.0, help="of each clip, from its beginning")
    options = parser.parse_args()
    data = options.data

    def loaded(name: str) -> mf.Character:
        return mf.load_character(data / f"characters/{name}.glb" if data else f"builtin:{name}")

    rows, bars = [], {}
    for kind in options.clips if data else ("walk",):
        clip = mf.load_motion(data / f"{KINDS[kind]}.bvh") if data else samples.walk(cycles=2)
        clip = clip[: max(1, round(options.seconds * clip.frame_rate))]
        for name in options.bodies or (["heavy_male"] if data else ["heavy"]):
            own = "avg_male" if data else "average"
            mf.adapt(clip, loaded(name), reference=loaded(own))
            total, spent = profiled(clip, loaded(name), loaded(own))
            each = {k: 1000 * s / clip.frame_count for k, s in spent.items()}
            whole = 1000 * total / clip.frame_count
            each["rest"] = whole - sum(each[k] for k in WORK)
            rows += [[kind, name, part, f"{ms:.2f}", f"{100 * ms / whole:.0f}"] for part, ms in each.items()]
            rows.append([kind, name, "all", f"{whole:.2f}", "100"])
            bars[f"{kind}, {name}"] = {k: each[k] for k in (*WORK, "rest")}
    table("Where the time goes", ["clip", "body", "part", "ms/frame", "%"], rows, options.out, "profile")

    def draw(axes) -> None:
        left = [0.0] * len(bars)
        for part in (*WORK, "rest"):
            width = [bar[part] for bar in bars.values()]
            axes.barh(list(bars), width, left=left, label=part)
            left = [a + b for a, b in zip(left, width, strict=True)]
        axes.set_xlabel("ms per frame, warm")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=4)

    save_figure(
        options.out / "profile.png", "Where the time of an adaptation goes", draw, size=(9, 2.5 + 0.5 * len(bars))
    )


if __name__ == "__main__":
    main()

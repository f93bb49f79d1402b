"""How well footplants are found: this library's labelling against fixed thresholds, the adaptive threshold and the
dot product, on clips that were labelled by hand from their height and speed curves.

    python -m benchmarks.footplants --data FOLDER [--body avg_male] [--plot PICTURE.png] [--tune]

FOLDER holds bvh/*.bvh, locomotion/*.bvh and characters/*.glb; the labels lie in tests/data/footplants. Prints per
method the F1 of each label, their mean, precision and recall of contacts per foot, how far the boundaries are off
[frames at 120 per second], how many flights of at least 50 ms were found, and the time per frame. `--tune` gives
the fixed thresholds the height and the speed that are best on these very clips.
"""

import argparse
import itertools
import pathlib
import time
from collections.abc import Callable

import numpy as np

import motionfit as mf
from motionfit._skeleton import SIDES
from motionfit.feet import detect, find_sole, gather, load_labels
from motionfit.feet._classics import dot_product, fixed_thresholds
from motionfit.feet._cycles import find_constraints, planted_by
from motionfit.feet._plants import LABELS, runs

HAND = pathlib.Path(__file__).parents[1] / "tests" / "data" / "footplants"
Labelled = tuple[str, mf.Motion, np.ndarray]


def labelled(data: pathlib.Path, body: mf.Character) -> list[Labelled]:
    """(name, clip on the body, hand labels (frames, 2)) of all clips that are labelled."""
    found = []
    for path in sorted(HAND.rglob("*.csv")):
        name = path.relative_to(HAND).with_suffix("").as_posix()
        motion = mf.onto(mf.load_motion(data / f"{name}.bvh"), body.skeleton)
        truth = np.zeros((motion.frame_count, 2), bool)
        for plant in load_labels(path, motion.frame_count, float(motion.dt)):
            truth[plant.start : plant.end + 1, SIDES.index(plant.foot)] = True
        found.append((name, motion, truth))
    return found


def methods(body: mf.Character, height: float = 0.05, speed: float = 0.5) -> dict[str, Callable]:
    sole = find_sole(body)

    def by_dot_product(motion):
        return dot_product(sole, gather(sole, motion), np.asarray(motion.root, float), float(motion.dt))

    return {
        "motionfit": lambda m: detect(sole, m)[0].planted,
        f"fixed {100 * height:.0f} cm, {speed:.2f} m/s": lambda m: fixed_thresholds(m, height=height, speed=speed),
        "adaptive threshold (Glardon)": lambda m: planted_by(find_constraints(m), m.frame_count),
        "dot product (Lyard)": by_dot_product,
    }


def score(found: list[np.ndarray], clips: list[Labelled]) -> dict[str, float]:
    """F1 per label, precision and recall of contacts, boundary errors and flights."""
    mine = np.concatenate([f @ [1, 2] for f in found])
    truth = np.concatenate([t @ [1, 2] for _, _, t in clips])
    result: dict[str, float] = {}
    for k, label in enumerate(LABELS):
        hits, said, there = ((mine == k) & (truth == k)).sum(), (mine == k).sum(), (truth == k).sum()
        result[f"F1 {label}"] = 2 * hits / max(said + there, 1)
    result["mean F1"] = float(np.mean([result[f"F1 {label}"] for label in LABELS]))
    both = [np.concatenate(x) for x in (found, [t for _, _, t in clips])]
    result["precision"] = (both[0] & both[1]).sum() / max(both[0].sum(), 1)
    result["recall"] = (both[0] & both[1]).sum() / max(both[1].sum(), 1)
    errors, flights, seen = [], 0, 0
    for planted, (_, motion, hand) in zip(found, clips, strict=True):
        to_120 = 120.0 * float(motion.dt)
        for foot, last in itertools.product((0, 1), (0, 1)):
            edges = [r[last] for r in runs(planted[:, foot])]
            for run in runs(hand[:, foot]):
                if run[last] not in (0, len(hand) - 1):
                    off = min((abs(run[last] - e) for e in edges), default=len(hand)) * to_120
                    errors.append(min(off, 24.0))  # beyond 0.2 s it is another boundary
        for start, end in runs(~np.any(hand, axis=1)):
            if (end - start + 1) * float(motion.dt) >= 0.05:
                flights += 1
                seen += bool((~planted[start : end + 1].any(1)).mean() > 0.5)
    result["boundary median"], result["boundary 90 %"] = np.percentile(errors, [50, 90])
    result["flights found"] = seen / max(flights, 1)
    return result


def tuned(clips: list[Labelled], body: mf.Character) -> tuple[float, float]:
    """The fixed height [m] and speed [m/s] of the best mean F1 on these clips."""
    options = itertools.product((0.02, 0.03, 0.04, 0.05, 0.07, 0.1), (0.15, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3))
    return max(options, key=lambda o: score([fixed_thresholds(m, height=o[0], speed=o[1]) for _, m, _ in clips], clips)["mean F1"])  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=pathlib.Path, required=True)
    parser.add_argument("--body", default="avg_male")
    parser.add_argument("--plot", type=pathlib.Path)
    parser.add_argument("--tune", action="store_true")
    options = parser.parse_args()
    body = mf.load_character(options.data / f"characters/{options.body}.glb")
    clips = labelled(options.data, body)
    height, speed = tuned(clips, body) if options.tune else (0.05, 0.5)
    table = {}
    for name, label in methods(body, height, speed).items():
        label(clips[0][1])
        started = time.perf_counter()
        found = [label(m) for _, m, _ in clips]
        seconds = time.perf_counter() - started
        table[name] = score(found, clips) | {"us per frame": 1e6 * seconds / sum(len(f) for f in found)}
        table[name]["_found"] = found
    keys = [k for k in next(iter(table.values())) if not k.startswith("_")]
    print(f"{len(clips)} clips, {sum(m.frame_count for _, m, _ in clips)} frames")
    print("| method | " + " | ".join(keys) + " |\n" + "|---" * (len(keys) + 1) + "|")
    for name, row in table.items():
        print(f"| {name} | " + " | ".join(f"{row[k]:.1f}" if row[k] > 1 else f"{row[k]:.3f}" for k in keys) + " |")
    if options.plot:
        draw(options.plot, clips, {name: row["_found"] for name, row in table.items()})


def draw(path: pathlib.Path, clips: list[Labelled], found: dict[str, list[np.ndarray]]) -> None:
    """Bars of the labels over time, one row per clip: by hand, then by each method."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.colors import ListedColormap

    colors = ListedColormap(["#f2f2f2", "#4477aa", "#cc6677", "#997799"])
    figure, axes = plt.subplots(len(clips), 1, figsize=(14, 1.15 * len(clips)), constrained_layout=True)
    for k, (name, motion, hand) in enumerate(clips):
        rows = np.stack([hand @ [1, 2], *(f[k] @ [1, 2] for f in found.values())])
        axes[k].imshow(rows, aspect="auto", interpolation="nearest", cmap=colors, vmin=0, vmax=3,
                       extent=(0, motion.frame_count * float(motion.dt), len(rows), 0))  # fmt: skip
        axes[k].set_yticks(np.arange(len(rows)) + 0.5, ["by hand", *found] if k == 0 else [""] * len(rows), fontsize=7)
        axes[k].set_title(name, fontsize=8, loc="left", pad=2)
        axes[k].tick_params(labelsize=7, length=2)
    axes[-1].set_xlabel("s   (grey: flight, blue: left, red: right, violet: both)", fontsize=8)
    figure.savefig(path, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    main()

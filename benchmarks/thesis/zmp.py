"""Tables 5.4 and F.3, figures 5.17 and 5.18: the zero-moment point of each mass model against the truth.

    python -m benchmarks.thesis.zmp [--data FOLDER] [--bodies NAME ...] [--out DIR]

The truth are the masses of the cut mesh as rigid bodies with their angular momentum; the models are point masses, as
in the thesis ("+ spin": with the volumes' own angular momentum). The distance counts in frames with a planted foot that
carries weight.
"""

from typing import NamedTuple

import numpy as np

import motionfit as mf
from benchmarks.thesis import _printed as printed
from benchmarks.thesis._setting import (
    MODELS,
    arguments,
    bodies,
    clips,
    kinematics,
    planted_feet,
    save_figure,
    table,
    truth,
)
from motionfit.balance import optimised_masses, support_polygon, zero_moment_point, zmp_distance
from motionfit.shape.mass import RADIUS_SCALES, mass_volumes, volume_masses

FIGURES: dict[str, tuple[str, ...]] = {
    "5.17": ("Jumps", "Run in circle", "360° rotation"),
    "5.18": ("Slow walk", "Normal walk", "Fast walk", "Skip", "Lean"),
}
COLOURS = {"truth": "k", "cylinders": "tab:blue", "ellipsoids": "tab:green", "optimised": "tab:red"}  # the thesis's


class Path(NamedTuple):
    """What a figure shows of a motion, in the plane (x, z) [m]."""

    points: dict[str, np.ndarray]  # per mass model
    counted: np.ndarray  # frames with a support
    corners: np.ndarray  # of the soles
    feet: np.ndarray  # which are down


def main() -> None:
    options = arguments(__doc__ or "")
    motions = clips(options)
    errors: dict[str, dict[str, dict[str, np.ndarray]]] = {}
    first, paths_of = "", {}
    for body, character in bodies(options).items():
        true, models = truth(character), {k: f(character) for k, f in MODELS.items()}
        models["cylinders, table 5.5"] = volume_masses(mass_volumes(character), RADIUS_SCALES["cylinder"])
        errors[body] = {}
        for name, clip in motions.items():
            motion = mf.onto(clip, character.skeleton)
            soles, feet, ground = planted_feet(character, motion)
            kin = kinematics(character.skeleton, motion)
            counted = np.asarray(zmp_distance(kin, true, soles, feet, ground=ground).supported)
            paths = {"truth": zero_moment_point(kin, true, ground=ground)}
            optimised = optimised_masses(kin, models["cylinders"], soles, feet, ground=ground)
            for model, masses in {**models, "optimised": optimised}.items():
                paths[model] = zero_moment_point(kin, masses, spin=False, ground=ground)
            paths["cylinders + spin"] = zero_moment_point(kin, models["cylinders"], ground=ground)
            points = {k: np.asarray(z.point_world)[:, [0, 2]] for k, z in paths.items()}
            errors[body][name] = {
                k: 100 * np.linalg.norm(p - points["truth"], axis=1)[counted] for k, p in points.items() if k != "truth"
            }
            first = first or body
            if body == first:
                paths_of[name] = Path(points, counted, np.asarray(soles.corners_world(kin))[..., [0, 2]], feet)

    kinds = list(next(iter(next(iter(errors.values())).values())))
    for body, found in errors.items():
        rows: list[list] = [
            [name, *(f"{e[k].mean():.2f} ({e[k].std():.2f})" for k in kinds)] for name, e in found.items()
        ]
        rows.append(["mean", *(float(np.mean([e[k].mean() for e in found.values()])) for k in kinds)])
        table(
            f"Table F.3, {body}: distance from the true ZMP [cm] (SD)",
            ["motion", *kinds],
            rows,
            options.out,
            f"table_F_3_{body}",
        )
    thesis = [[name, *(f"{m:.2f} ({s:.2f})" for m, s in row)] for name, row in printed.ZMP_ERROR_PER_MOTION.items()]
    table(
        "Thesis table F.3 [cm] (SD)",
        ["motion", "cylinders", "ellipsoids", "optimised"],
        thesis,
        options.out,
        "thesis_table_F_3",
    )

    rows = []
    for k in kinds:
        means = {b: float(np.mean([e[k].mean() for e in found.values()])) for b, found in errors.items()}
        spread = float(np.mean([e[k].std() for found in errors.values() for e in found.values()]))
        mean = float(np.mean(list(means.values())))
        rows.append([k, mean, spread, *means.values(), printed.ZMP_ERROR.get(k, (None,))[0]])
    columns = ["model", "mean", "SD", *errors, "thesis"]
    table("Table 5.4: distance from the true ZMP [cm]", columns, rows, options.out, "table_5_4")

    for number, names in FIGURES.items():
        shown = {n: paths_of[n] for n in names if n in paths_of}
        if shown:
            save_figure(
                options.out / f"figure_{number.replace('.', '_')}.png",
                f"Figure {number}: the zero-moment point of each mass model, on {first}",
                lambda axes, shown=shown: draw(np.atleast_1d(axes), shown),
                # turns and jumps stay in one place, walks go far
                panels=(1, len(shown)) if number == "5.17" else (len(shown), 1),
                size=(13.0, 4.5) if number == "5.17" else (10.0, 1.0 + 2.2 * len(shown)),
            )


def draw(every: np.ndarray, paths: dict[str, Path]) -> None:
    """One panel per motion, seen from above, the longer way of the two to the right; soles that are down in grey."""
    for axes, (name, path) in zip(every, paths.items(), strict=True):
        around = path.corners[path.feet].reshape(-1, 2)
        right, up = (1, 0) if np.ptp(around[:, 1]) > np.ptp(around[:, 0]) else (0, 1)
        for t in range(0, len(path.counted), 6):
            for foot in np.flatnonzero(path.feet[t]):
                polygon = support_polygon(path.corners[t, foot])
                axes.fill(polygon[:, right], polygon[:, up], color="0.88", lw=0)
        for model, colour in COLOURS.items():
            points = np.where(path.counted[:, None], path.points[model], np.nan)
            axes.plot(points[:, right], points[:, up], color=colour, lw=1.1, label=model)
        # what leaves the picture of the feet by more than a foot's length says only that it does
        axes.set(xlim=(around[:, right].min() - 0.3, around[:, right].max() + 0.3),
                 ylim=(around[:, up].min() - 0.15, around[:, up].max() + 0.15),
                 xlabel=f"{'xz'[right]} [m]", ylabel=f"{'xz'[up]} [m]", aspect="equal")  # fmt: skip
        axes.set_title(name, fontsize=10)
    every[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False)


if __name__ == "__main__":
    main()

"""Tables 5.4 and F.3, figures 5.17 and 5.18: the zero-moment point of each mass model against the truth.

    python -m benchmarks.thesis.zmp [--data FOLDER] [--bodies NAME ...] [--out DIR]

The truth are the masses of the cut mesh as rigid bodies with their angular momentum; the models are point masses, as
in the thesis ("+ spin": with the volumes' own angular momentum). The distance counts in frames with a planted foot that
carries weight.
"""

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


def main() -> None:
    options = arguments(__doc__ or "")
    motions = clips(options)
    errors: dict[str, dict[str, dict[str, np.ndarray]]] = {}
    first = None
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
            if first is None:
                first = (body, name, points, counted, np.asarray(soles.corners_world(kin))[..., [0, 2]], feet)

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

    def draw(axes):
        assert first is not None
        _, _, points, counted, corners, feet = first
        for t in range(0, len(counted), 6):
            for foot in range(2):
                if feet[t, foot]:
                    axes.fill(*support_polygon(corners[t, foot]).T[::-1], color="0.85", lw=0)
        for label, colour in (
            ("truth", "k"),
            ("cylinders", "tab:blue"),
            ("ellipsoids", "tab:green"),
            ("optimised", "tab:red"),
        ):
            path = np.where(counted[:, None], points[label], np.nan)
            axes.plot(path[:, 1], path[:, 0], color=colour, label=label)
        axes.set(xlabel="z [m]", ylabel="x [m]", aspect="equal")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.4), ncols=4)

    assert first is not None
    save_figure(options.out / "figure_5_18.png", f"Zero-moment point, {first[1]} on {first[0]}", draw)


if __name__ == "__main__":
    main()

"""Table F.4: how far the true zero-moment point is from its support, per motion.

python -m benchmarks.thesis.support [--data FOLDER] [--bodies NAME ...] [--out DIR]
"""

import numpy as np

import motionfit as mf
from benchmarks.thesis import _printed as printed
from benchmarks.thesis._setting import arguments, bodies, clips, kinematics, planted_feet, save_figure, table, truth
from motionfit.balance import balance_measures, zmp_distance


def main() -> None:
    options = arguments(__doc__ or "")
    motions = clips(options)
    found: dict[str, dict[str, dict]] = {}
    series: dict[str, np.ndarray] = {}
    for body, character in bodies(options).items():
        masses = truth(character)
        found[body] = {}
        for name, clip in motions.items():
            motion = mf.onto(clip, character.skeleton)
            soles, feet, ground = planted_feet(character, motion)
            kin = kinematics(character.skeleton, motion)
            distance = zmp_distance(kin, masses, soles, feet, ground=ground)
            found[body][name] = balance_measures(distance) | {"frames": motion.frame_count}
            series.setdefault(name, np.where(distance.supported, 100 * np.asarray(distance.outside), np.nan))

    def cell(m: dict) -> str:
        if m["zmp_distance_mean_m"] is None:
            return "-"
        return f"{100 * m['zmp_distance_mean_m']:.2f} ({100 * m['zmp_distance_sd_m']:.2f})"

    rows = []
    for name in motions:
        mean, sd = printed.SUPPORT_DISTANCE[name]
        rows.append([name, *(cell(found[b][name]) for b in found), f"{mean:.2f} ({sd:.2f})"])
    means = [float(np.mean([100 * (m["zmp_distance_mean_m"] or 0.0) for m in found[b].values()])) for b in found]
    rows.append(["mean", *means, printed.SUPPORT_DISTANCE_MEAN])
    rows.append(
        [
            "supported frames, %",
            *(100 * float(np.mean([m["supported_frames"] / m["frames"] for m in found[b].values()])) for b in found),
            None,
        ]
    )
    table(
        "Table F.4: distance of the true ZMP from its support [cm] (SD)",
        ["motion", *found, "thesis"],
        rows,
        options.out,
        "table_F_4",
    )

    def draw(axes):
        for name, values in series.items():
            axes.plot(np.arange(len(values)) / options.fps, values, label=name)
        axes.set(xlabel="time [s]", ylabel="distance [cm]")
        axes.legend()

    save_figure(options.out / "table_F_4.png", "Distance of the zero-moment point from its support", draw)


if __name__ == "__main__":
    main()

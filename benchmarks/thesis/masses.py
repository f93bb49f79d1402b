"""Tables 5.1, 5.2 and 5.3, F.1 and F.2: mass and its distribution per limb and model.

    python -m benchmarks.thesis.masses [--data FOLDER] [--bodies NAME ...] [--out DIR]

The thesis measured one man by X-ray; here the truth is the closed mesh cut into segments, and the bodies are many.
"""

import numpy as np

import motionfit as mf
from benchmarks.thesis import _printed as printed
from benchmarks.thesis._setting import (
    LIMB_NAMES,
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
from motionfit.balance import optimised_masses
from motionfit.shape.mass import LIMBS


def main() -> None:
    options = arguments(__doc__ or "")
    shares: dict[str, dict[str, list[float]]] = {}
    characters = bodies(options)
    for name, character in characters.items():
        models = {**{k: f(character) for k, f in MODELS.items()}, "truth (mesh)": truth(character)}
        limbs = {k: m.limbs() for k, m in models.items()}
        rows = [[LIMB_NAMES[limb], *(1e3 * limbs[k][limb] for k in models)] for limb in LIMBS]
        rows.append(["Total", *(1e3 * sum(limbs[k].values()) for k in models)])
        table(f"Table 5.1, {name}: mass [g]", ["limb", *models], rows, options.out, f"table_5_1_{name}")
        shares[name] = {k: [100 * limbs[k][limb] / sum(limbs[k].values()) for limb in LIMBS] for k in models}
        rows = [[LIMB_NAMES[limb], *(shares[name][k][i] for k in models)] for i, limb in enumerate(LIMBS)]
        # what the ZMP cares for: half the sum of the differences is the share of mass that sits in the wrong limb
        wrong = [np.abs(np.subtract(shares[name][k], shares[name]["truth (mesh)"])).sum() / 2 for k in models]
        rows.append(["in the wrong limb", *wrong])
        table(f"Table 5.2, {name}: share of the total [%]", ["limb", *models], rows, options.out, f"table_5_2_{name}")
    thesis = [[LIMB_NAMES[limb], *(printed.SHARE[k][i] for k in printed.SHARE)] for i, limb in enumerate(LIMBS)]
    wrong = [np.abs(np.subtract(v, printed.SHARE["measured"])).sum() / 2 for v in printed.SHARE.values()]
    thesis.append(["in the wrong limb", *wrong])
    table("Thesis table 5.2 [%]", ["limb", *printed.SHARE], thesis, options.out, "thesis_table_5_2")

    # 5.3: optimised masses, on the first body
    name, character = next(iter(characters.items()))
    start = MODELS["cylinders"](character)
    found = {}
    for clip_name, clip in clips(options).items():
        motion = mf.onto(clip, character.skeleton)
        soles, feet, ground = planted_feet(character, motion)
        kin = kinematics(character.skeleton, motion)
        found[clip_name] = optimised_masses(kin, start, soles, feet, ground=ground).limbs()
    rows = [[LIMB_NAMES[limb], *(1e3 * m[limb] for m in found.values())] for limb in LIMBS]
    table(f"Tables F.1 and F.2, {name}: optimised masses [g]", ["limb", *found], rows, options.out, "table_F_1_F_2")
    rows = []
    for limb in LIMBS:
        values = 1e3 * np.array([m[limb] for m in found.values()])
        spread = float(values.std(ddof=1)) if len(values) > 1 else None
        rows.append([LIMB_NAMES[limb], float(values.mean()), spread, *map(float, printed.OPTIMISED[limb])])
    columns = ["limb", "mean", "SD", "thesis mean", "thesis SD"]
    table(f"Table 5.3, {name}: mean of the optimised masses [g]", columns, rows, options.out, "table_5_3")

    def draw(axes):
        models = list(next(iter(shares.values())))
        for i, model in enumerate(models):
            mean = np.mean([s[model] for s in shares.values()], axis=0)
            axes.bar(np.arange(len(LIMBS)) + 0.8 * i / len(models), mean, 0.8 / len(models), align="edge", label=model)
        axes.set_xticks(np.arange(len(LIMBS)) + 0.4, [LIMB_NAMES[limb] for limb in LIMBS])
        axes.set_ylabel("share of the total mass [%]")
        axes.legend()

    save_figure(options.out / "table_5_2.png", "Mass distribution per model, mean over the bodies", draw)


if __name__ == "__main__":
    main()

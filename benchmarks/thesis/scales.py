"""Table 5.5: what the radii of the volumes must be multiplied by to give the true distribution of the mass.

    python -m benchmarks.thesis.scales [--data FOLDER] [--bodies NAME ...] [--out DIR]

The square root of the ratio of the shares: checked on table 5.2, from which it gives the thesis's own scales.
"""

import numpy as np

from benchmarks.thesis import _printed as printed
from benchmarks.thesis._setting import LIMB_NAMES, MODELS, arguments, bodies, save_figure, table, truth
from motionfit.shape.mass import LIMBS


def scales(share: list[float], true: list[float]) -> np.ndarray:
    return np.sqrt(np.array(true) / np.array(share))


def main() -> None:
    options = arguments(__doc__ or "", clips=False)
    found: dict[str, dict[str, np.ndarray]] = {"cylinders": {}, "ellipsoids": {}}
    for body, character in bodies(options).items():
        true = truth(character).limbs()
        for kind in found:
            own = MODELS[kind](character).limbs()
            shares = [[m[limb] / sum(m.values()) for limb in LIMBS] for m in (own, true)]
            found[kind][body] = scales(*shares)
    for k, kind in enumerate(found):
        own = scales(list(printed.SHARE[kind]), list(printed.SHARE["measured"]))
        rows = [
            [
                LIMB_NAMES[limb],
                *(float(v[i]) for v in found[kind].values()),
                printed.RADIUS_SCALE[limb][k],
                float(own[i]),
            ]
            for i, limb in enumerate(LIMBS)
        ]
        columns = ["limb", *found[kind], "thesis", "thesis, from 5.2"]
        table(f"Table 5.5: scales of the {kind}", columns, rows, options.out, f"table_5_5_{kind}")

    def draw(axes):
        for i, (kind, values) in enumerate(found.items()):
            for j, (body, v) in enumerate(values.items()):
                axes.plot(v, "os"[i], color=f"C{j}", label=f"{kind}, {body}")
            axes.plot([printed.RADIUS_SCALE[limb][i] for limb in LIMBS], "+x"[i], color="k", label=f"{kind}, thesis")
        axes.set_xticks(range(len(LIMBS)), [LIMB_NAMES[limb] for limb in LIMBS])
        axes.axhline(1.0, color="0.8")
        axes.legend(fontsize="x-small", ncols=2)

    save_figure(options.out / "table_5_5.png", "Radius scales", draw)


if __name__ == "__main__":
    main()

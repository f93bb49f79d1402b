"""Figure 4.9: the objective of the forearm block (4.7), its valley, and where one start and many starts end.

python -m benchmarks.thesis.valley [--out DIR]

A straight arm whose forearm should point behind the plane in which the elbow bends. From zero every bend leads uphill, so
that the solver stays (the thesis's yellow sphere); a turn of the upper arm first leads to the minimum (green). The
thesis starts again from the ten best points of a grid of 0.1 rad, and so does `motionfit.adapt.multi_start`.
"""

from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import motionfit as mf
from benchmarks.thesis._setting import argument_parser, table
from motionfit._control import Control, Correction, Drive
from motionfit._motion import Motion
from motionfit._solve import block_work
from motionfit.adapt._forearm import costs_on_grid
from motionfit.splines import bspline_basis
from motionfit.terms import Direction, Effort

BLOCK = mf.Block("forearm", ("twist", "bend"))
FRAMES = 8


def trap() -> mf.Problem:
    """An arm that hangs straight down, and a forearm that should point away from the way it bends."""
    names = ["hips", "left_upper_arm", "left_forearm", "left_hand"]
    skeleton = mf.Skeleton(names, [-1, 0, 1, 2], np.array([[0, 0, 0], [0, 0, 0], [0, -0.3, 0], [0, -0.25, 0.0]], float))
    motion = Motion(skeleton, np.zeros((FRAMES, 3)), np.tile([1.0, 0, 0, 0], (FRAMES, 4, 1)), 1 / 60)
    basis = bspline_basis(FRAMES, 1 / 60, 0.1)
    controls = (Control("twist", (Drive(1, np.array([0.0, -1.0, 0.0]), 1.0),), basis),
                Control("bend", (Drive(2, np.array([-1.0, 0.0, 0.0]), 1.0),), basis, 0.0, np.pi / 2))  # fmt: skip
    away = Rotation.from_rotvec([0.0, -np.deg2rad(120.0), 0.0]) * Rotation.from_rotvec([-1.0, 0.0, 0.0])
    target = np.tile(away.apply([0.0, -1.0, 0.0]), (FRAMES, 1, 1))
    terms = {"direction": Direction((2,), (3,), target), "effort": Effort(2.0)}
    body = eqx.tree_at(lambda c: c.skeleton, mf.load_character("builtin:average"), skeleton)
    return mf.Problem(body, motion, terms, controls)


def cost(problem: mf.Problem, correction: Correction) -> float:
    return sum(float(c) for c in problem.costs(correction).values())


def surface(problem: mf.Problem, twist: np.ndarray, bend: np.ndarray) -> np.ndarray:
    """The cost of constant turns [rad], one row per bend."""
    zero = tuple(jnp.asarray(p, float) for p in Correction.zero(problem.controls).points)
    grid = np.stack(np.meshgrid(twist, bend), axis=-1).reshape(-1, 2)
    return np.asarray(costs_on_grid(block_work(problem, BLOCK, zero), jnp.asarray(grid))).reshape(len(bend), len(twist))


def place(correction: Correction) -> tuple[float, float]:
    """The mean twist and bend [rad] of a correction, within their bounds."""
    twist, bend = (float(np.mean(np.clip(p, c.lower, c.upper)))
                   for c, p in zip(correction.controls, correction.points, strict=True))  # fmt: skip
    return twist, bend


def main() -> None:
    options = argument_parser(__doc__ or "", clips=False).parse_args()
    problem = trap()
    zero = Correction.zero(problem.controls)
    found = {"start": zero, "one start": mf.fit(problem, (BLOCK,)).correction,
             "ten of a grid": mf.adapt.multi_start(problem, BLOCK)}  # fmt: skip
    rows = [[name, *(np.rad2deg(place(c))), cost(problem, c)] for name, c in found.items()]
    table("Figure 4.9: where the forearm's block ends", ["from", "twist [deg]", "bend [deg]", "cost"], rows, options.out,
          "figure_4_9")  # fmt: skip

    from matplotlib.figure import Figure

    twist, bend = np.linspace(-np.pi / 2, np.pi / 2, 91), np.linspace(0.0, np.pi / 2, 46)
    heights = surface(problem, twist, bend)
    x, y = np.meshgrid(np.rad2deg(twist), np.rad2deg(bend))
    marks = {
        "zero, where one start stays": ("start", "gold"),
        "minimum, from ten starts": ("ten of a grid", "limegreen"),
    }
    spheres = [(label, color, *np.rad2deg(place(found[name])), cost(problem, found[name]))
               for label, (name, color) in marks.items()]  # fmt: skip
    angles = {"xticks": [-90, -45, 0, 45, 90], "xlabel": "twist [deg]", "yticks": [0, 45, 90], "ylabel": "bend [deg]"}
    figure = Figure(figsize=(14, 4.8), layout="constrained")
    for k, (name, elevation, azimuth) in enumerate((("side view", 8, -90), ("perspective", 32, -60)), start=1):
        axes = cast(Any, figure.add_subplot(1, 3, k, projection="3d", computed_zorder=False))
        axes.plot_surface(x, y, heights, cmap="viridis", rcount=46, ccount=46, linewidth=0)
        for _, color, *point in spheres:
            axes.plot(*([c] for c in point), "o", color=color, mec="k", ms=9)
        axes.view_init(elevation, azimuth)
        axes.set_box_aspect((1.2, 1.0, 0.9), zoom=0.9)
        axes.set(**angles, title=name, zticklabels=[])
        if k == 1:  # seen along it
            axes.set(yticks=[], ylabel="")
    axes = figure.add_subplot(1, 3, 3)
    figure.colorbar(axes.contourf(x, y, heights, 24, cmap="viridis"), ax=axes, label="cost")
    for label, color, a, b, _ in spheres:
        axes.plot([a], [b], "o", color=color, mec="k", ms=10, label=label, clip_on=False, zorder=5)
    axes.set(**angles, title="top")
    axes.legend(loc="upper left", fontsize=9)
    figure.suptitle("Figure 4.9: the forearm's objective over constant turns")
    path = options.out / "figure_4_9.png"
    figure.savefig(path, dpi=110)
    print(f"  plot: {path}")


if __name__ == "__main__":
    main()

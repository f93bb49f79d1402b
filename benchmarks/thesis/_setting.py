"""What the scripts of this folder share: clips, bodies, mass models, planted feet, and how a table is written."""

import argparse
import pathlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

import motionfit as mf
from motionfit import samples
from motionfit._motion import bind_pose, host_kinematics
from motionfit.balance import Soles, sole_boxes
from motionfit.shape.mass import Masses, anthropometric_masses, mass_volumes, mesh_masses, volume_masses
from motionfit.shape.volumes import fit_volumes

# The thesis's eight motions (5.6.2), and clips of the same kinds. Its own captures are not public.
CLIPS: dict[str, str] = {
    "Normal walk": "bvh/02_01_walk", "360° rotation": "bvh/05_11_sideways_steps_pirouette",
    "Run in circle": "bvh/16_42_run_90deg_left_turn", "Lean": "bvh/02_06_bend_over_scoop_up",
    "Slow walk": "bvh/05_01_slow_walk", "Fast walk": "bvh/16_21_fast_walk", "Jumps": "bvh/16_01_jump",
    "Skip": "bvh/131_03_start_hop_stop",
}  # fmt: skip
BODIES = ("avg_male", "thin_male", "tall_male", "heavy_male", "avg_female", "short_female")
BUILTIN_BODIES = ("average", "heavy", "slim")
LIMB_NAMES = {"head": "Head", "right_arm": "Right Arm", "left_arm": "Left Arm", "trunk": "Trunk",
              "left_leg": "Left Leg", "right_leg": "Right Leg"}  # fmt: skip

# The mass models that are compared, besides the truth (the cut mesh).
MODELS: dict[str, Callable[[mf.Character], Masses]] = {
    "cylinders": lambda c: volume_masses(mass_volumes(c, "cylinder")),
    "ellipsoids": lambda c: volume_masses(mass_volumes(c, "ellipsoid")),
    "reach cylinders": lambda c: volume_masses(fit_volumes(c, "cylinder")),
    "de Leva": lambda c: anthropometric_masses(c, sex="female" if "female" in c.name else "male"),
}


def arguments(description: str, *, clips: bool = True) -> argparse.Namespace:
    return argument_parser(description, clips=clips).parse_args()


def argument_parser(description: str, *, clips: bool = True) -> argparse.ArgumentParser:
    """The options that all scripts know, for those that add some of their own."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=pathlib.Path, help="folder with bvh/*.bvh and characters/*.glb")
    parser.add_argument("--bodies", nargs="*", help="stems in characters/, or built-in names without --data")
    if clips:
        parser.add_argument("--fps", type=float, default=60.0)
        parser.add_argument(
            "--clips", nargs="*", choices=CLIPS, default=list(CLIPS), metavar="KIND", help=", ".join(CLIPS)
        )
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("benchmark_results"))
    return parser


def bodies(options: argparse.Namespace) -> dict[str, mf.Character]:
    if options.data is None:
        return {name: mf.load_character(f"builtin:{name}") for name in options.bodies or BUILTIN_BODIES}
    return {n: mf.load_character(options.data / f"characters/{n}.glb") for n in options.bodies or BODIES}


def clips(options: argparse.Namespace) -> dict[str, mf.Motion]:
    if options.data is None:
        return {"Normal walk": samples.walk(frame_rate=options.fps)}
    return {
        k: mf.load_motion(options.data / f"{v}.bvh", fps=options.fps) for k, v in CLIPS.items() if k in options.clips
    }


# one program per clip length instead of one per operation
kinematics = eqx.filter_jit(mf.forward_kinematics)


class Planted(NamedTuple):
    """The sole boxes, which foot is down in each frame, and the floor's height [m]."""

    soles: Soles
    feet: np.ndarray
    ground: float


def planted_feet(character: mf.Character, motion: mf.Motion, height: float = 0.05, speed: float = 0.5) -> Planted:
    """A foot is down where its heel or ball is within `height` [m] of the floor and the slower of ankle and toe moves
    at less than `speed` [m/s]: the fixed thresholds of the classics, enough to label a benchmark.

    Heights are those of the ankle and the toe joint over their height above the sole in the bind pose (the corners
    of the rigid sole box dip into the floor where the toes bend); the floor is their second percentile.
    """
    skeleton, soles = character.skeleton, sole_boxes(character)
    positions, bind = host_kinematics(motion)[0], bind_pose(skeleton)[0]
    sole = np.asarray(character.skin.vertices_bind)[:, 1].min()
    lows, slow = [], []
    for side in ("left", "right"):
        joints = [j for role in ("foot", "toe") if (j := skeleton.find(f"{side}_{role}")) is not None]
        path = positions[:, joints]
        lows.append((path[..., 1] - (bind[joints, 1] - sole)).min(axis=1))
        slow.append(np.linalg.norm(np.gradient(path, float(motion.dt), axis=0), axis=-1).min(axis=1) < speed)
    low = np.stack(lows, axis=1)
    ground = float(np.percentile(low.min(axis=1), 2))
    return Planted(soles, (low < ground + height) & np.stack(slow, axis=1), ground)


def truth(character: mf.Character) -> Masses:
    """The masses that count as true: the closed mesh, cut into its segments, with the densities of table 4.1."""
    return mesh_masses(character)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence], out: pathlib.Path, name: str) -> None:
    """Print a table and write it as CSV."""
    cells = [[c if isinstance(c, str) else "-" if c is None else f"{c:.2f}" for c in row] for row in rows]
    widths = [max(len(c) for c in column) for column in zip(columns, *cells, strict=True)]
    print(f"\n{title}")
    for line in (list(columns), ["-" * w for w in widths], *cells):
        print(
            "  "
            + "  ".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True)))
        )
    out.mkdir(parents=True, exist_ok=True)
    text = "\n".join(",".join(f'"{c}"' if "," in c else c for c in line) for line in (list(columns), *cells))
    (out / f"{name}.csv").write_text(text + "\n", encoding="utf-8")


def save_figure(
    path: pathlib.Path, title: str, draw: Callable, panels: tuple[int, int] = (1, 1), size: tuple[float, float] = (9, 5)
) -> None:
    """One plot, drawn by `draw(axes)`, without a display; or rows and columns of `panels`, by `draw(array of axes)`."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(*panels, figsize=size, layout="constrained")
    figure.suptitle(title)
    draw(axes)
    figure.savefig(path, dpi=120)
    plt.close(figure)
    print(f"  plot: {path}")

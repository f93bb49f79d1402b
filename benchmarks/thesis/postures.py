"""Figures 5.8 to 5.15: postures adapted to other bodies, over those of the original.

python -m benchmarks.thesis.postures [--data FOLDER] [--figures 5.8 ...] [--seconds S] [--out DIR]

The thesis shows: 5.8 a jump, 5.9 a skip, 5.10 a pose with self-collisions, 5.11 a walk of a scanned body, 5.12 a body with
limbs grown, 5.13 a body that grows as it walks, 5.14 and 5.15 what per-frame IK (4.10) does for plump bodies. Its
captures and bodies are not public: clips of the same kinds, made for avg_male, stand for them. A part is the redder the
deeper it is in another, beyond what the original shows on its own body.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import motionfit as mf
from benchmarks.thesis._setting import argument_parser
from benchmarks.thesis.pipeline import KINDS
from motionfit import samples
from motionfit._motion import Motion
from motionfit.adapt import build_clearance, reference_depths, volume_depths
from motionfit.metrics import posed_vertices
from motionfit.shape import PAIRS
from motionfit.view.plots import draw_body, excess_colors

PLUMP = {"arms": 1.25, "legs": 1.2, "trunk": 1.35}
GROWN: tuple[dict[str, float], ...] = ({}, {"arms": 1.7}, {"trunk": 1.5}, {"legs": 1.4}, PLUMP)
AGES = (1.0, 1.2, 1.4, 1.6)  # girths that are solved; in between the motion is interpolated
RESULT, ORIGINAL = (0.13, 0.55, 0.25), (0.80, 0.13, 0.13)  # the thesis's green and red
BETWEEN = 1.0  # [m] from one posture to the next


class Scene(NamedTuple):
    """A figure of one clip on one body: `adapt(clip, body, reference=)`, and the share of the clip that is shown."""

    title: str
    kind: str
    body: str
    adapt: Callable[..., mf.Fit] = mf.adapt.adapt
    girth: dict[str, float] = {}
    span: tuple[float, float] = (0.05, 0.95)
    superimposed: bool = False


SCENES: dict[str, Scene] = {
    "5.8": Scene("a jump", "jump", "heavy_male", span=(0.35, 0.75)),
    "5.9": Scene("a skip", "hop", "heavy_male"),
    "5.10": Scene("a pose with self-collisions", "hands on hip", "heavy_male",
                  functools.partial(mf.adapt.adapt, blocks=mf.adapt.BLOCKS), span=(0.3, 1.0)),
    "5.11": Scene("a walk", "walk", "heavy_male"),
    "5.14": Scene("per-frame IK, a plump woman", "slow walk", "avg_female", mf.adapt.per_frame_ik, PLUMP),
    "5.15": Scene("per-frame IK, a plump walk", "walk", "avg_male", mf.adapt.per_frame_ik, PLUMP, superimposed=True),
}  # fmt: skip


class Stage:
    """Where clips and bodies come from: a folder, or what is built in."""

    def __init__(self, data, seconds: float):
        self.data, self.seconds = data, seconds
        self.reference = self.body("avg_male")

    def body(self, name: str, girth: dict[str, float] | None = None) -> mf.Character:
        builtin = "builtin:heavy" if name == "heavy_male" else "builtin:average"
        found = mf.load_character(self.data / f"characters/{name}.glb" if self.data else builtin)
        return mf.shape.grow(found, girth) if girth else found

    def clip(self, kind: str) -> Motion:
        clip = mf.load_motion(self.data / f"{KINDS[kind]}.bvh", fps=60.0) if self.data else samples.walk(cycles=1)
        return clip[: max(2, round(self.seconds * clip.frame_rate))]


class Posture(NamedTuple):
    """A body in one frame of a motion, with the excess depths [m] of its pairs, and what is written under it."""

    character: mf.Character
    motion: Motion
    frame: int
    excess: np.ndarray
    label: str


def postures(
    stage: Stage,
    clip: Motion,
    character: mf.Character,
    motion: Motion,
    frames: Sequence[int] | np.ndarray,
    label: str = "",
) -> list[Posture]:
    """Postures in some frames, with their times under them where there is no `label`."""
    at = np.asarray(frames)
    limit = reference_depths(clip[at], character, stage.reference, PAIRS)
    excess = volume_depths(build_clearance(character, PAIRS), motion[at]) - limit
    return [Posture(character, motion, int(f), e, label or f"{f * float(motion.dt):.2f} s")
            for f, e in zip(at, excess, strict=True)]  # fmt: skip


def draw_row(axes, row: Sequence[Posture], color: tuple[float, float, float] | None = None, alpha: float = 1.0) -> None:
    """Postures side by side, seen half from the side; in one `color`, or red where parts are in each other."""
    floor = np.inf
    for k, (character, motion, frame, excess, _) in enumerate(row):
        way = np.asarray(motion.root, float)[-1] - np.asarray(motion.root, float)[0]
        heading = float(np.arctan2(way[0], way[2])) if np.hypot(way[0], way[2]) > 0.3 else 0.0
        vertices = posed_vertices(character, motion[np.array([frame])])[0]
        vertices = vertices - np.asarray(motion.root)[frame] * np.array([1.0, 0.0, 1.0])
        colors = (np.tile(color, (len(vertices), 1)) if color
                  else excess_colors(character, excess, [p.name for p in PAIRS]))  # fmt: skip
        draw_body(axes, vertices, np.asarray(character.skin.faces), yaw=0.45 - heading, shift=BETWEEN * k, colors=colors,
                  alpha=alpha)  # fmt: skip
        floor = min(floor, float(vertices[:, 1].min()))
    for k, posture in enumerate(row):
        axes.text(BETWEEN * k, floor - 0.12, posture.label, ha="center", fontsize=9)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.axis("off")


def picture(path, title: str, rows: dict[str, list[Posture]], superimposed: bool = False) -> None:
    """Rows of postures over each other, the first on top; or all in one place."""
    from matplotlib.figure import Figure

    count = max(len(row) for row in rows.values())
    heights = 1 if superimposed else len(rows)
    figure = Figure(figsize=(1.0 + 1.8 * count, 0.5 + 3.6 * heights), layout="constrained")
    every = figure.subplots(heights, 1, squeeze=False, sharex=True, sharey=True)[:, 0]
    if superimposed:
        for (name, row), color, alpha in zip(rows.items(), (RESULT, ORIGINAL), (1.0, 0.45), strict=True):
            draw_row(every[0], row if alpha == 1.0 else [p._replace(label="") for p in row], color, alpha)
            every[0].plot([], [], "s", color=color, label=name)
        figure.legend(frameon=False, loc="outside lower center", ncols=2)
    else:
        for axes, (name, row) in zip(every, rows.items(), strict=True):
            draw_row(axes, row)
            worst = 100 * max(float(p.excess.max()) for p in row)
            axes.set_title(f"{name}: at worst {max(worst, 0.0):.1f} cm too deep", fontsize=11)
    figure.suptitle(title, fontsize=13)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    print(f"  plot: {path}", flush=True)


def scene(stage: Stage, what: Scene) -> dict[str, list[Posture]]:
    """Figures of one clip on one body."""
    clip, character = stage.clip(what.kind), stage.body(what.body, what.girth)
    fit = what.adapt(clip, character, reference=stage.reference)
    frames = ((clip.frame_count - 1) * np.linspace(*what.span, 6)).round().astype(int)
    return {name: postures(stage, clip, character, m, frames) for name, m in
            (("adapted", fit.motion), ("original", fit.base))}  # fmt: skip


def grown(stage: Stage) -> dict[str, list[Posture]]:
    """Figure 5.12: one moment of a walk, limbs grown one after the other."""
    clip, rows = stage.clip("walk"), {"grown and adapted": [], "grown": []}
    for girth in GROWN:
        character, label = (
            stage.body("avg_male", girth),
            ", ".join(f"{k} {v:g}" for k, v in girth.items()) or "as it is",
        )
        fit = mf.adapt.adapt(clip, character, reference=stage.reference, blocks=("arms", "legs"))
        for row, motion in zip(rows.values(), (fit.motion, fit.base), strict=True):
            row += postures(stage, clip, character, motion, [clip.frame_count // 3], label)
    return rows


def growing(stage: Stage) -> dict[str, list[Posture]]:
    """Figure 5.13: the body grows while it walks. A few girths are solved, between two of them the turns go from one to
    the other."""
    clip = stage.clip("walk")
    solved = list(mf.adapt.adapt_many(clip, (stage.body("avg_male", _all(a)) for a in AGES), workers=1,
                                      reference=stage.reference, blocks=("arms", "legs")))  # fmt: skip
    frames = np.linspace(0, clip.frame_count - 1, 7).round().astype(int)
    rows: dict[str, list[Posture]] = {"grown and adapted": [], "grown": []}
    for frame, age in zip(frames, np.linspace(AGES[0], AGES[-1], len(frames)), strict=True):
        below = min(int(np.searchsorted(AGES, age, side="right")) - 1, len(AGES) - 2)
        share = (age - AGES[below]) / (AGES[below + 1] - AGES[below])
        character = stage.body("avg_male", _all(age))
        base = mf.onto(clip, character.skeleton)
        motion = between(solved[below], solved[below + 1], share, base)
        for row, m in zip(rows.values(), (motion, base), strict=True):
            row += postures(stage, clip, character, m, [int(frame)], f"girth {age:.1f}")
    return rows


def between(first: mf.Fit, second: mf.Fit, share: float, base: Motion) -> Motion:
    """`base` turned by what two fits of the same clip turn theirs by, the second with a `share` of 0 to 1."""
    turns = []
    for fit in (first, second):
        before, after = (Rotation.from_quat(np.asarray(m.rotations, float).reshape(-1, 4), scalar_first=True)
                         for m in (fit.base, fit.motion))  # fmt: skip
        turns.append((after * before.inv()).as_rotvec())
    own = Rotation.from_quat(np.asarray(base.rotations, float).reshape(-1, 4), scalar_first=True)
    turned = Rotation.from_rotvec((1.0 - share) * turns[0] + share * turns[1]) * own
    rotations = turned.as_quat(scalar_first=True).reshape(np.shape(base.rotations))
    return Motion(base.skeleton, base.root, rotations, base.dt, base.translations)


def _all(scale: float) -> dict[str, float]:
    return dict.fromkeys(("arms", "legs", "trunk"), scale)


FIGURES: dict[str, tuple[str, Callable[[Stage], dict[str, list[Posture]]]]] = {
    **{number: (what.title, functools.partial(scene, what=what)) for number, what in SCENES.items()},
    "5.12": ("limbs grown one after the other", grown), "5.13": ("a body that grows as it walks", growing),
}  # fmt: skip


def main() -> None:
    parser = argument_parser(__doc__ or "", clips=False)
    parser.add_argument("--figures", nargs="*", choices=sorted(FIGURES), default=sorted(FIGURES), metavar="NUMBER")
    parser.add_argument("--seconds", type=float, default=4.0, help="of each clip, from its beginning")
    options = parser.parse_args()
    stage = Stage(options.data, options.seconds)
    for number in options.figures:
        title, make = FIGURES[number]
        superimposed = number in SCENES and SCENES[number].superimposed
        name = f"figure_{number.replace('.', '_')}.png"
        picture(options.out / name, f"Figure {number}: {title}", make(stage), superimposed)


if __name__ == "__main__":
    main()

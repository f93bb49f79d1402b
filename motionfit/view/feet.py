"""Pictures of feet: footprints, the path of the planted vertex over the sole, contact curves, snapshots, reach."""

import os
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from motionfit._character import Character
from motionfit._files import whole
from motionfit._motion import Motion
from motionfit.feet import FootFit, Footplants, Sole, find_sole, gather, sole_paths
from motionfit.ik import plane_angles
from motionfit.metrics import posed_vertices
from motionfit.view.plots import draw_body

BEFORE, AFTER = "#3a8f4f", "#2b5fb4"  # the colours of Lyard 2007, figure 4: green is the original, blue the result
SIDES = (("left", "#4477aa"), ("right", "#cc6677"))


def _save(path: str | os.PathLike, size: tuple[float | int, float | int], draw: Callable) -> None:
    """Draw a figure without a display and write it whole or not at all."""
    from matplotlib.figure import Figure  # not pyplot: that would need a backend, and a notebook has chosen its own

    figure = Figure(figsize=size, layout="constrained")
    draw(figure)
    with whole(path) as partial:
        figure.savefig(partial, format="png", dpi=110)


def _outline(points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "corners 2"]:
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).vertices]
    except QhullError:  # all points on one line
        return points


def footprints_picture(path: str | os.PathLike, fit: FootFit, title: str = "") -> None:
    """The prints that the planted feet leave on the ground before and after, seen from above, with the root's path:
    thesis figures 5.5 and 5.6. A foot that slides smears its print."""

    way = (np.asarray(fit.base.root, float)[-1] - np.asarray(fit.base.root, float)[0])[[0, 2]]
    forward = way / np.linalg.norm(way) if np.linalg.norm(way) > 0.3 else np.array([0.0, 1.0])

    def ground(points: np.ndarray) -> np.ndarray:
        """Seen from above, the way to the right."""
        x, z = points[..., 0], points[..., 2]
        return np.stack([x * forward[0] + z * forward[1], x * forward[1] - z * forward[0]], axis=-1)

    def draw(figure) -> None:
        from matplotlib.collections import PolyCollection

        axes = figure.subplots(2, 1, sharex=True, sharey=True)
        for ax, (name, motion, color) in zip(
            axes, (("before", fit.base, BEFORE), ("after", fit.motion, AFTER)), strict=True
        ):
            paths, root = sole_paths(fit.sole, motion), np.asarray(motion.root, float)
            # ten prints per second and foot; in between they would hide each other
            step = max(1, round(0.1 / fit.plants.dt))
            prints = [
                _outline(ground(paths[frame, fit.sole.of(foot)]))
                for foot in (0, 1)
                for frame in np.flatnonzero(fit.plants.planted[:, foot])
                if frame % step == 0
            ]
            ax.add_collection(PolyCollection(prints, facecolors=color, edgecolors="k", linewidths=0.4, alpha=0.25))
            ax.plot(*ground(root).T, color="0.4", linewidth=1, label="root")
            slide = 100 * fit.measure(motion)["slide_path_m"]
            ax.set_title(f"{name}: planted feet slide {slide:.1f} cm in all", fontsize=10)
            ax.set_aspect("equal")
            ax.autoscale_view()
        axes[0].legend(fontsize=8, frameon=False)
        axes[1].set_xlabel("m")
        figure.suptitle(title, fontsize=11)

    _save(path, (11, 6), draw)


def sole_picture(path: str | os.PathLike, character: Character, plants: Footplants) -> None:
    """The planted vertex's way over each sole, plant by plant: thesis figure 3.3."""
    sole = find_sole(character, cells=None)
    bind = np.asarray(character.skin.vertices_bind)

    def draw(figure) -> None:
        for foot, ax in enumerate(figure.subplots(1, 2)):
            mine = sole.vertices[sole.of(foot)]
            faces = np.asarray(character.skin.faces)
            ax.triplot(bind[:, 0], bind[:, 2], faces[np.isin(faces, mine).all(1)], color="0.8", linewidth=0.5)
            intervals = [p for p in plants.plants if p.foot == SIDES[foot][0]]
            for k, plant in enumerate(intervals):
                used = plants.vertex[plant.start : plant.end + 1, foot]
                stops = used[np.append(True, np.diff(used) != 0)]
                x, z = bind[stops, 0], bind[stops, 2]
                color = f"C{k % 10}"
                ax.plot(x, z, "o", color=color, markersize=4)
                for a in range(len(stops) - 1):
                    ax.annotate("", (x[a + 1], z[a + 1]), (x[a], z[a]), arrowprops={"arrowstyle": "->", "color": color})
            ax.set_aspect("equal")
            ax.set_title(f"{SIDES[foot][0]}: {len(intervals)} plants", fontsize=10)
            ax.set_xlabel("m")

    _save(path, (7, 6), draw)


def curves_picture(
    path: str | os.PathLike, character: Character, motion: Motion, plants: Footplants | None = None
) -> None:
    """Height and speed of each foot's stillest low vertex with the bounds that decide, and the labels: Glardon 2006,
    figures 4, 5 and 9. `motion` is on the character."""
    from motionfit.feet._detect import NEAR, STILL, detect, leg_scale

    sole: Sole = find_sole(character)
    plants = detect(sole, motion)[0] if plants is None else plants
    evidence = gather(sole, motion, plants.floor)
    seconds, size = np.arange(motion.frame_count) * float(motion.dt), leg_scale(character.skeleton)

    def draw(figure) -> None:
        axes = figure.subplots(2, 1, sharex=True)
        for foot, (name, color) in enumerate(SIDES):
            axes[0].plot(seconds, 100 * evidence.height[:, foot], color=color, label=name)
            axes[1].plot(seconds, evidence.speed_low[:, foot], color=color)
            down = np.where(plants.planted[:, foot], -1.0 - foot, np.nan)
            axes[0].plot(seconds, down, color=color, linewidth=4, solid_capstyle="butt")
        axes[0].axhline(100 * NEAR * size, color="0.5", linestyle="--", linewidth=0.8)
        axes[1].axhline(STILL * size, color="0.5", linestyle="--", linewidth=0.8)
        axes[0].set(ylim=(-3, 15), ylabel="height over the floor [cm]")
        axes[1].set(ylim=(0, 2.5 * STILL * size), ylabel="speed [m/s]", xlabel="s")
        axes[0].legend(fontsize=8, frameon=False)
        for ax in axes:
            ax.spines[["top", "right"]].set_visible(False)

    _save(path, (11, 5.5), draw)


def snapshots_picture(path: str | os.PathLike, character: Character, fit: FootFit, count: int = 6) -> None:
    """The body at a few moments before (red) and after (green), one over the other: thesis figure 5.7."""
    frames = np.unique(np.linspace(0, fit.base.frame_count - 1, count).astype(int))
    faces = np.asarray(character.skin.faces)
    way = np.asarray(fit.base.root)[-1] - np.asarray(fit.base.root)[0]
    yaw = -float(np.arctan2(way[0], way[2])) + np.pi / 2 if np.hypot(way[0], way[2]) > 0.3 else 0.5

    def draw(figure) -> None:
        ax = figure.subplots()
        for motion, color in ((fit.base, (0.80, 0.13, 0.13)), (fit.motion, (0.13, 0.55, 0.25))):
            colors = np.tile(color, (len(character.skin.vertices_bind), 1))
            for vertices in posed_vertices(character, motion[frames]):
                draw_body(ax, vertices, faces, yaw=yaw, colors=colors, alpha=0.55)
        ax.set_aspect("equal")
        ax.autoscale_view()
        ax.axis("off")

    _save(path, (12, 5), draw)


def reach_picture(
    path: str | os.PathLike, thigh: Float[np.ndarray, "2"], shank: Float[np.ndarray, "2"], samples: int = 300
) -> None:
    """Where the analytic leg reaches, and by which value of its arc sine: thesis figure 3.10.

    `thigh` and `shank` [m] are the leg in its plane as (y, z), y up. White where the principal value of (C.12)
    satisfies (C.9) for the first value of (C.11), black where the other one does; grey cannot be reached.
    """
    length = float(np.linalg.norm(thigh) + np.linalg.norm(shank))
    line = np.linspace(-1.1 * length, 1.1 * length, samples)
    z, y = np.meshgrid(line, line)
    targets = np.stack([y, z], axis=-1).reshape(-1, 2)
    upper, lower = (np.broadcast_to(v, targets.shape) for v in (thigh, shank))
    found = plane_angles(upper, lower, targets - thigh - shank)
    # (C.10): the first value of the arc sine is the one whose cosine is positive
    k1, k = np.arctan2(shank[1], shank[0]), np.arctan2(targets[:, 0], targets[:, 1])
    first = (np.cos(found.ankle[0] + k1 + k) < 0).astype(int)
    hip = np.take_along_axis(found.hip, first[None], axis=0)[0]
    principal = np.cos(hip + np.arctan2(thigh[0], thigh[1])) >= 0
    shade = np.where(found.reachable, np.where(principal, 1.0, 0.0), 0.55).reshape(z.shape)

    def draw(figure) -> None:
        ax = figure.subplots()
        ax.imshow(shade, cmap="gray", vmin=0, vmax=1, origin="lower", extent=(line[0], line[-1], line[0], line[-1]))
        knee = thigh
        ankle = thigh + shank
        ax.plot([0, knee[1], ankle[1]], [0, knee[0], ankle[0]], "o-", color="#cc3311")
        ax.set(xlabel="z [m]", ylabel="y [m]")

    _save(path, (5.5, 5.5), draw)

"""report.png: penetration over time per pair, and the body before and after, drawn without a display."""

import pathlib

import numpy as np
from jaxtyping import Float

from motionfit._character import PARTS, Character
from motionfit._files import whole
from motionfit._motion import Motion
from motionfit.metrics import TOLERANCE, posed_vertices

SKIN = np.array([0.86, 0.70, 0.60])
RED = np.array([0.80, 0.13, 0.13])


def draw_body(
    axes,
    vertices_world: Float[np.ndarray, "vertices 3"],
    faces: np.ndarray,
    *,
    yaw: float = 0.6,
    shift: float = 0.0,
    colors: Float[np.ndarray, "vertices 3"] | None = None,
    alpha: float = 1.0,
) -> None:
    """Draw a body with matplotlib alone: faces turned away are left out, the rest painted from far to near.

    `yaw` [rad] turns the view about the vertical, `shift` [m] moves the drawing to the right.
    """
    from matplotlib.collections import PolyCollection

    c, s = np.cos(yaw), np.sin(yaw)
    points = vertices_world @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    front = normals[:, 2] > 0
    order = np.flatnonzero(front)[np.argsort(corners[front][:, :, 2].mean(1))]
    light = np.clip(0.38 + 0.62 * normals[order] @ np.array([0.35, 0.45, 0.82]), 0.15, 1.0)
    base = SKIN[None] if colors is None else colors[faces[order]].mean(1)
    shaded = np.clip(light[:, None] * base, 0, 1)
    outline = corners[order][:, :, :2] + [shift, 0.0]
    edges = "face" if alpha == 1.0 else "none"  # they close the gaps, and would be a net over what is transparent
    # an array is drawn without a copy, which matplotlib's stub does not know
    faced = PolyCollection(outline, facecolors=shaded, edgecolors=edges, linewidths=0.25, alpha=alpha)  # pyright: ignore[reportArgumentType]
    axes.add_collection(faced)


def report_picture(
    path: str | pathlib.Path,
    character: Character,
    before: Motion,
    after: Motion,
    excess_before: Float[np.ndarray, "frames pairs"],
    excess_after: Float[np.ndarray, "frames pairs"],
    pairs: list[str],
    title: str = "",
) -> None:
    """Three moments before and after, and the excess depth [m] of every pair that shows any, over time.

    The moments are the worst frame before, and the worst of the thirds of the clip that it does not lie in.
    """
    from matplotlib.figure import Figure  # not pyplot: that would need a backend, and a notebook has chosen its own

    moments = _moments(excess_before)
    shown = [k for k in range(len(pairs)) if max(excess_before[:, k].max(), excess_after[:, k].max()) > 1e-3]
    shown = sorted(shown, key=lambda k: -excess_before[:, k].max())[:9]
    figure = Figure(figsize=(15, 10.5), layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=[1.35, 1.0])
    # one scale for both: arms that are led out would else make the same body look smaller
    bodies = grid[0].subgridspec(1, 2)
    axes = None
    for column, (name, motion, excess) in enumerate(
        (("before", before, excess_before), ("after", after, excess_after))
    ):
        axes = figure.add_subplot(bodies[column], sharex=axes, sharey=axes)
        _draw_moments(axes, character, motion, excess, moments, pairs)
        worst = 100 * float(np.maximum(excess, 0).max(initial=0.0))
        axes.set_title(f"{name}: at worst {worst:.1f} cm deeper than allowed", fontsize=13)
    if shown:
        rows = -(-len(shown) // 3)
        curves = grid[1].subgridspec(rows, min(3, len(shown)))
        top = 100 * 1.1 * max(float(excess_before[:, shown].max()), TOLERANCE * 1.3)
        for i, k in enumerate(shown):
            axes = figure.add_subplot(curves[i // 3, i % 3])
            _draw_curve(axes, before, excess_before[:, k], excess_after[:, k], pairs[k], top, i)
    else:
        axes = figure.add_subplot(grid[1])
        axes.axis("off")
        axes.text(0.5, 0.5, "no pair of parts goes deeper than on the reference body", ha="center", fontsize=14)
    figure.suptitle(title, fontsize=14)
    with whole(path) as partial:
        figure.savefig(partial, format="png", dpi=110)


def _moments(excess: np.ndarray) -> list[int]:
    """The worst frame of each third of the clip."""
    worst = np.maximum(excess, 0).max(1) if excess.size else np.zeros(len(excess))
    thirds = [t for t in np.array_split(np.arange(len(worst)), 3) if len(t)]
    return [int(t[worst[t].argmax()]) for t in thirds]


def excess_colors(
    character: Character, excess: Float[np.ndarray, " pairs"], pairs: list[str]
) -> Float[np.ndarray, "vertices 3"]:
    """Skin, the redder a part is the deeper it is in another: fully red from 3 cm of `excess` [m] on."""
    colors = np.tile(SKIN, (len(character.part_of_vertex), 1))
    for k, pair in enumerate(pairs):
        share = np.clip(excess[k] / 0.03, 0.0, 1.0)
        if excess[k] > 0.002:
            mine = character.part_of_vertex == PARTS.index(pair.split("/")[0])
            colors[mine] = np.minimum(colors[mine], (1 - share) * SKIN + share * RED)
    return colors


def _draw_moments(axes, character: Character, motion: Motion, excess, moments: list[int], pairs: list[str]) -> None:
    faces = np.asarray(character.skin.faces)
    posed = posed_vertices(character, motion[np.array(moments)])
    way = np.asarray(motion.root)[-1] - np.asarray(motion.root)[0]
    heading = float(np.arctan2(way[0], way[2])) if np.hypot(way[0], way[2]) > 0.3 else 0.0
    width = 0.62 * float(np.ptp(np.asarray(character.skin.vertices_bind)[:, 1]))
    for i, frame in enumerate(moments):
        vertices = posed[i] - np.asarray(motion.root)[frame] * np.array([1.0, 0.0, 1.0])
        colors = excess_colors(character, excess[frame], pairs)
        draw_body(axes, vertices, faces, yaw=0.45 - heading, shift=i * width, colors=colors)
        axes.text(i * width, -0.10, f"{frame * float(motion.dt):.2f} s", ha="center", fontsize=11)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.axis("off")


def _draw_curve(axes, motion: Motion, before, after, name: str, top: float, index: int) -> None:
    seconds = np.arange(len(before)) * float(motion.dt)
    axes.fill_between(seconds, 100 * np.maximum(before, 0), color=RED, alpha=0.18, linewidth=0)
    axes.plot(seconds, 100 * np.maximum(before, 0), color=RED, label="before")
    axes.plot(seconds, 100 * np.maximum(after, 0), color="#1b6e3c", label="after")
    axes.axhline(100 * TOLERANCE, color="0.5", linewidth=0.8, linestyle="--")
    axes.set_ylim(0, top)
    axes.set_title(name.replace("_", " ").replace("/", " in "), fontsize=10, loc="left")
    axes.tick_params(labelsize=8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if index % 3 == 0:
        axes.set_ylabel("excess [cm]", fontsize=9)
    axes.set_xlabel("time [s]", fontsize=9)
    if index == 0:
        axes.legend(fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=2)  # over no curve

"""The verbs of this package: detect footplants, remove footskate, and what they return."""

import os
from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from motionfit._character import PARTS, Character
from motionfit._motion import Motion
from motionfit._onto import onto
from motionfit._skeleton import SIDES
from motionfit._types import InputError
from motionfit.feet._detect import Evidence, assemble, detect, gather
from motionfit.feet._enforce import enforce
from motionfit.feet._floor import Floor
from motionfit.feet._leg import with_leg_ik
from motionfit.feet._plants import Footplants, Plant, load_labels
from motionfit.feet._root import frame_heights, horizontal_path, scaled_heights
from motionfit.feet._sole import Sole, find_sole, rows_of, sole_paths
from motionfit.metrics import contact_preservation, feet_summary

METHODS = ("root", "leg-ik", "adaptive")
VERTICALS = ("scale", "frame", "none")
TOLERANCE = 1e-3  # [m] of slide per frame inside a plant: what counts as a violation that is left


class FootFit(eqx.Module):
    """A motion with its footskate removed.

    `motion` is the result and `base` the clip on the character as it came, `plants` the footplants that were held
    (by every method), and `reachable` says per frame and foot whether a leg could reach where its foot should stand (all
    True for the root method, which moves no leg).
    """

    motion: Motion
    base: Motion
    plants: Footplants
    method: str = eqx.field(static=True)
    reachable: Bool[np.ndarray, "frames 2"]
    details: Mapping[str, float]
    sole: Sole

    @property
    def status(self) -> str:
        """ "converged", or "violations_left": a planted vertex still slides over 1 mm in a frame, or a foot could not
        reach its place; "no_progress" where no foot is ever down, so that nothing could be done."""
        if not self.plants.planted.any():
            return "no_progress"
        slide = self.measure(self.motion)["slide_max_m_s"] or 0.0
        left = slide * self.plants.dt > TOLERANCE or not self.reachable.all()
        return "violations_left" if left else "converged"

    def measure(self, motion: Motion) -> dict:
        """report.json's `feet` entry of a motion, for these footplants and this floor."""
        paths = sole_paths(self.sole, motion)
        return summarise(self.sole, paths, self.plants)

    def report(self) -> dict:
        """What was found, done and left: floor, plants, and the `feet` measures before and after."""
        labels, floor = self.plants.labels, self.plants.floor
        before, after = self.measure(self.base), self.measure(self.motion)
        again = detect(self.sole, self.motion, None if self.method == "root" else floor)[0]
        after["contact_preservation"] = contact_preservation(again.planted, self.plants.planted)
        return {
            "method": self.method, "status": self.status,
            "floor": {"height_m": floor.height, "slope_x": floor.slope_x, "slope_z": floor.slope_z,
                      "tilt_rad": floor.tilt},
            "frames": {name: int((labels == name).sum()) for name in ("none", "left", "right", "both")},
            "plants": len(self.plants.plants),
            "unreachable_frames": int((~self.reachable).any(1).sum()),
            **{k: float(v) for k, v in self.details.items()},
            "before": {"feet": before}, "after": {"feet": after},
        }  # fmt: skip


def summarise(sole: Sole, paths: Float[np.ndarray, "frames soles 3"], plants: Footplants) -> dict:
    """The `feet` entry of sole paths under footplants."""
    rows = rows_of(sole, plants.vertex)
    return feet_summary(paths, plants.floor.above(paths), sole.side, rows, plants.primary, plants.dt)


def measure_feet(character: Character, motion: Motion, plants: Footplants | None = None) -> dict:
    """report.json's `feet` entry of a motion on a character; footplants are detected where none are given."""
    motion = onto(motion, character.skeleton)
    sole = _sole_for(character, () if plants is None else np.unique(plants.vertex[plants.vertex >= 0]))
    if plants is None:
        plants = detect(sole, motion)[0]
    return summarise(sole, sole_paths(sole, motion), plants)


def detect_footplants(
    motion: Motion,
    character: Character,
    *,
    floor: Floor | float | None = None,
    labels: str | os.PathLike | tuple[Plant, ...] | None = None,
) -> Footplants:
    """Which foot is down in each frame, on which vertex, and how sure that is: "none", "left", "right", "both".

    No kind of motion has to be named: see `motionfit.feet`. `floor` is the ground where it is known (a height [m],
    or a `Floor`), else it is fitted to the contacts. `labels`, a CSV file or plants, says instead when feet are
    down; the vertices that it leaves open ("any") are chosen. A clip on another skeleton is put on the character
    first. Returns `Footplants`.

        plants = mf.detect_footplants(clip, body)
        plants.labels, plants.floor.tilt
        plants.save("plants.csv")
    """
    return _plants(onto(motion, character.skeleton), character, floor, labels)[0]


def _as_floor(floor: Floor | float | None) -> Floor | None:
    if floor is None or isinstance(floor, Floor):
        return floor
    try:
        height = float(floor)
    except (TypeError, ValueError):
        height = np.nan
    if not np.isfinite(height):
        raise InputError(f"floor {floor!r} is not a height in metres; give a number, or feet.Floor(height, 0, 0)")
    return Floor(height)


def _sole_for(character: Character, named) -> Sole:
    """The sole, with vertices that labels name added to it."""
    for vertex in named:
        if not 0 <= vertex < len(character.part_of_vertex):
            raise InputError(f"{character.name}: vertex {vertex} is not in the mesh, whose last is "
                             f"{len(character.part_of_vertex) - 1}")  # fmt: skip
        if PARTS[character.part_of_vertex[vertex]] not in ("left_foot", "right_foot"):
            raise InputError(f"{character.name}: vertex {vertex} belongs to {PARTS[character.part_of_vertex[vertex]]}, "
                             "not to a foot; name a vertex of the sole, or any")  # fmt: skip
    return find_sole(character, include=tuple(int(v) for v in named))


def _plants(motion: Motion, character: Character, floor, labels) -> tuple[Footplants, Sole, Evidence]:
    """Footplants, the sole they refer to, and what is known of its vertices."""
    dt, frames = float(motion.dt), motion.frame_count
    if frames == 0:
        raise InputError("a motion without frames has no footplants; give one frame or more")
    if labels is None:
        sole = _sole_for(character, ())
        plants, evidence = detect(sole, motion, _as_floor(floor))
        return plants, sole, evidence
    known = labels if isinstance(labels, tuple) else load_labels(labels, frames, dt)
    sole = _sole_for(character, sorted({p.vertex for p in known if p.vertex is not None}))
    planted, vertex = np.zeros((frames, 2), bool), np.full((frames, 2), -1)
    for plant in known:
        foot = SIDES.index(plant.foot)
        planted[plant.start : plant.end + 1, foot] = True
        if plant.vertex is not None:
            if sole.side[sole.row(plant.vertex)] != foot:
                raise InputError(f"vertex {plant.vertex} is not on the {plant.foot} foot (frames {plant.start} to "
                                 f"{plant.end}); correct the label")  # fmt: skip
            vertex[plant.start : plant.end + 1, foot] = plant.vertex
    evidence = gather(sole, motion, _as_floor(floor), planted)
    return assemble(sole, evidence, planted, planted.astype(float), dt, vertex), sole, evidence


def remove_footskate(
    motion: Motion,
    character: Character,
    method: str = "root",
    *,
    plants: Footplants | None = None,
    labels: str | os.PathLike | tuple[Plant, ...] | None = None,
    floor: Floor | float | None = None,
    vertical: str = "scale",
    lift: float | None = None,
) -> FootFit:
    """A motion whose planted feet hold still.

    `method` "root" moves the root alone, and the rotations come back as the very same array (Lyard 2007, thesis
    3.1); "leg-ik" starts the hierarchy at the planted foot and bends the legs so that each foot stands exactly
    where it should (thesis 3.2); "adaptive" does so too, then finds by thresholds that adapt to the clip when heel
    and toe joints rest, and holds them by prioritized inverse kinematics (Glardon 2006).

    `plants` or `labels` (a CSV file) say when feet are down, else `detect_footplants` does. `floor` is where the
    feet shall stand (a height [m] or a `Floor`); without it they stay on the floor that the clip's contacts show.
    `vertical` is how the root method treats heights: "scale" (an offset and a scale for the whole clip), "frame"
    (Emering's correction of each frame) or "none". `lift` [m] lowers the character by that much before the legs are
    bent, so that they need not stretch (thesis 5.5.1); without it, only where and as far as a leg is too short.

        clean = mf.remove_footskate(clip, body)
        clean.motion, clean.status, clean.report()
    """
    if method not in METHODS:
        raise InputError(f"unknown method {method!r}; methods: {', '.join(METHODS)}")
    if vertical not in VERTICALS:
        raise InputError(f"unknown vertical correction {vertical!r}; there are {', '.join(VERTICALS)}")
    if lift is not None and not 0.0 <= lift <= 0.2:
        raise InputError(f"a lift from 0 to 0.2 m is allowed, got {lift:g}")
    base = onto(motion, character.skeleton)
    if plants is not None:
        if len(plants.planted) != base.frame_count:
            raise InputError(f"footplants of {len(plants.planted)} frames for a clip of {base.frame_count}; detect "
                             "them on this clip")  # fmt: skip
        sole = _sole_for(character, np.unique(plants.vertex[plants.vertex >= 0]))
        evidence = gather(sole, base, plants.floor)
    else:
        plants, sole, evidence = _plants(base, character, None, labels)
    target, rows = _as_floor(floor), rows_of(sole, plants.vertex)
    paths, speed = evidence.paths_world, evidence.speed
    if method == "root":
        result, details = _root(base, sole, plants, paths, speed, target, vertical)
        reachable = np.ones_like(plants.planted)
    elif method == "leg-ik":
        result, reachable, details = with_leg_ik(base, sole, plants, paths, rows, speed, target, lift)
    else:
        still, stands, details = with_leg_ik(base, sole, plants, paths, rows, speed, target, lift)
        result, reachable, more = enforce(still, sole, plants, plants.floor if target is None else target)
        reachable, details = reachable & stands, details | more
    if target is not None:
        plants = Footplants(plants.planted, plants.vertex, plants.confidence, plants.primary, target, plants.dt)
    return FootFit(result, base, plants, method, reachable, details, sole)


def _root(base: Motion, sole, plants, paths, speed, target, vertical) -> tuple[Motion, dict[str, float]]:
    """The root method: the motion, and the offset [m] and scale of its heights."""
    frames, root = np.arange(base.frame_count), np.asarray(base.root, float)
    held, standing_on = plants.primary >= 0, rows_of(sole, plants.carrier)
    moved = horizontal_path(root, paths - root[:, None], standing_on, speed, sole.side, float(base.dt))
    details = {"offset_m": 0.0, "scale": 1.0}
    floor = plants.floor if target is None else target
    if vertical == "scale":
        heights, offset, scale = scaled_heights(root, paths[frames, standing_on], held, plants.floor, target)
        details = {"offset_m": offset, "scale": scale}
    elif vertical == "frame":
        heights = frame_heights(root, plants.floor.above(paths).min(1), held, plants.floor)
    else:
        heights = plants.floor.above(root)
    moved[:, 1] = floor.at(moved) + heights
    new_root = moved.astype(np.asarray(base.root).dtype)
    return Motion(base.skeleton, new_root, base.rotations, base.dt, base.translations), details

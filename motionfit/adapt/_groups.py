"""What collides with what, as data: thesis 4.6 and the arguments of appendix E's `removeCollision`; and what of it comes
near in which frame."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter1d

from motionfit._character import PARTS, Character
from motionfit._motion import Motion, bind_pose
from motionfit._skeleton import SIDES
from motionfit._types import InputError
from motionfit.adapt._clearance import Clearance, counted_probes, kept_with, point_by_point, support
from motionfit.adapt._controls import Turn
from motionfit.adapt._sampling import Sampling
from motionfit.adapt._stages import smooth_floor
from motionfit.shape.field import fit_field
from motionfit.shape.pairs import Pair
from motionfit.shape.probes import Probes, ProbeSets
from motionfit.terms.penetration import SkinClearance, SkinContact

PROBES = 16  # of a part against another, in a solve
MEETINGS, MOST = 10, 16  # of parts, that a solve looks at: per frame on the mean, and in one frame at most
FAINT = 0.01  # weight of a touch, up to which there is none
AROUND = 0.05  # [s] around a meeting that count too: a spline takes its neighbours along


class Sphere(NamedTuple):
    """A ball that must stay empty of other parts: at a joint's role, or at a skin `vertex` that moves with it.

    `offset` [m] is added in the bind pose, y up and z ahead; `radius` [m].
    """

    role: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.0
    vertex: int | None = None

    def place_bind(self, character: Character) -> Float[np.ndarray, "3"]:
        joint = character.skeleton.joint(self.role)
        if self.vertex is None:
            start = bind_pose(character.skeleton)[0][joint]
        else:
            start = np.asarray(character.skin.vertices_bind, float)[self.vertex]
        return start + np.asarray(self.offset)


class Group(NamedTuple):
    """What collides with what, and what may turn to avoid it.

    `probes` are parts, whose skin is looked at, or spheres; `avoid` are parts. `turns` are the controls, each of which
    may drive several joints by the same amount or its inverse. A knot every `spacing` frames that the solver sees (60
    per second). Groups with the same turns and spacing are solved together, so that none undoes the other.
    """

    name: str
    probes: tuple[str | Sphere, ...]
    avoid: tuple[str, ...]
    turns: tuple[Turn, ...]
    spacing: int = 2


def arm_turns(side: str) -> tuple[Turn, ...]:
    """Shoulder about all axes, elbow about its two useful ones."""
    arm, elbow = f"{side}_upper_arm", f"{side}_forearm"
    return (*(Turn(f"{arm}_{axis}", ((arm, axis, 1.0),), 1.0) for axis in ("left", "up", "forward")),
            Turn(f"{elbow}_bend", ((elbow, "bend", 1.0),), 1.0),
            Turn(f"{elbow}_swing", ((elbow, "swing", 1.0),), 0.35))  # fmt: skip


def _hands(side: str, other: str) -> tuple[Group, ...]:
    arm, hand = (f"{side}_forearm", f"{side}_hand"), f"{side}_hand"
    turns = (*arm_turns("left"), *arm_turns("right"))  # of both arms: each may touch the other
    return (
        Group(f"{hand}/torso", (f"{side}_upper_arm", *arm), ("torso",), turns),
        Group(f"{hand}/head", arm, ("head",), turns),
        Group(f"{hand}/shoulder", arm, (f"{other}_upper_arm", f"{other}_forearm", f"{other}_hand"), turns),
        Group(f"{hand}/legs", arm, tuple(f"{s}_thigh" for s in SIDES), turns),
    )


def _bent(side: str) -> Group:
    """The trunk straightens for a leg drawn up: it leaves the feet where they are."""
    turns = tuple(Turn(f"trunk_{axis}", (("chest", axis, 1.0),), np.pi / 8) for axis in ("left", "forward"))
    return Group(f"{side}_leg/torso", (f"{side}_calf",), ("torso",), turns)


GROUPS: tuple[Group, ...] = (*_hands("left", "right"), *_hands("right", "left"), *(_bent(s) for s in SIDES))
"""The five tables of the thesis, per side: legs/torso, hands/torso, hands/head, hands/shoulders, hands/legs."""


class Known(NamedTuple):
    """The clearance of some groups on a body, a set of probes per row, the radius [m] of each, and which rows are those
    of a part's skin."""

    clearance: Clearance
    skin: SkinClearance  # its term
    radius: Float[np.ndarray, " rows"]
    on_skin: Bool[np.ndarray, " rows"]

    def depths(self, motion: Motion) -> Float[np.ndarray, "frames rows"]:
        """Depth [m] of each row in each frame; negative where there is a gap."""
        return self.rows(self.probe_depths(motion))

    def probe_depths(self, motion: Motion) -> Float[np.ndarray, "frames rows points"]:
        """Depth [m] of every probe in each frame."""
        return point_by_point(self.skin, motion)

    def rows(self, probes: Float[np.ndarray, "frames rows points"]) -> Float[np.ndarray, "frames rows"]:
        """The same, of probes' depths that are known."""
        return probes.max(axis=2).astype(float) + self.radius


def known_depths(character: Character, groups: Sequence[Group]) -> Known:
    pairs, probes, fields, field_of, parts, radius, on_skin = [], [], [], [], [], [], []
    for group in groups:
        for part in (p for p in (*group.avoid, *(q for q in group.probes if isinstance(q, str))) if p not in PARTS):
            raise InputError(f"group {group.name!r} names unknown part {part!r}; parts: {', '.join(PARTS)}")
        for probe in group.probes:
            for avoid in group.avoid:
                name = probe if isinstance(probe, str) else probe.role
                side = name.partition("_")[0] if name.startswith(SIDES) and avoid == "torso" else "left"
                if (avoid, side) not in fields:
                    fields.append((avoid, side))
                field_of.append(fields.index((avoid, side)))
                pairs.append(Pair(name, avoid, group.name))
                parts.append(name)
                radius.append(0.0 if isinstance(probe, str) else probe.radius)
                on_skin.append(isinstance(probe, str))
                probes.append(kept_with(character, counted_probes, probe, avoid) if isinstance(probe, str)
                              else _at_sphere(character, probe))  # fmt: skip
    term = SkinClearance(tuple(probes), tuple(kept_with(character, fit_field, *key) for key in fields),
                         tuple(field_of), (np.zeros((1, 1)),) * len(probes))  # fmt: skip
    return Known(Clearance(term, tuple(pairs), tuple(range(len(pairs))), tuple(parts)), term,
                 np.array(radius), np.array(on_skin))  # fmt: skip


def _at_sphere(character: Character, sphere: Sphere) -> Probes:
    place = sphere.place_bind(character)
    return Probes(np.array([character.skeleton.joint(sphere.role)]), np.append(place, 1.0)[None, :, None])


class Meetings:
    """What comes near what in each frame: a solve looks at those sets of probes that come nearest, and at those points
    of each that go deepest. What was near once stays so, that no round forgets what the one before it kept out."""

    def __init__(self, known: Known, at: Sampling):
        self.known, self.at = known, at
        self.near: Float[np.ndarray, "frames rows"] = np.full((len(at.frames), len(known.radius)), -np.inf)
        self.score: Float[np.ndarray, "rows points"] = np.zeros((1, 1))

    def seen(
        self, probes: Float[np.ndarray, "frames rows points"], limit: Float[np.ndarray, "frames rows"],
        beyond: Float[np.ndarray, "frames rows"],
    ) -> None:  # fmt: skip
        """Take note of a motion: the depths [m] of its probes, and how far each row is `beyond` what counts."""
        reach = 2 * round(AROUND / self.at.dt) + 1
        self.near = np.maximum(self.near, maximum_filter1d(beyond, reach, axis=0))
        self.score = np.maximum(self.score, support(self.known.clearance, probes, limit))

    def term(
        self, allowed: Float[np.ndarray, "frames rows"], gap: Float[np.ndarray, "frames rows"],
        weight: Float[np.ndarray, "frames rows"],
    ) -> SkinContact:  # fmt: skip
        """The rows that keep probes out, up to the depth [m] `allowed`, and those that keep a touch within a `gap` [m],
        as far as the `weight` says."""
        skin, radius, at = self.known.skin, self.known.radius, self.at
        near = np.where(weight > FAINT, np.inf, self.near)
        most, length = min(MOST, near.shape[1]), min(MEETINGS, near.shape[1]) * len(at.rows)
        nearest = np.argsort(-near, axis=1, kind="stable")[:, :most]
        order = np.argsort(-np.take_along_axis(near, nearest, axis=1), axis=None, kind="stable")[:length]
        frame, slot = np.unravel_index(np.sort(order), nearest.shape)
        met = nearest[frame, slot]
        meeting_of = np.full((len(at.rows), most), length)
        meeting_of[frame, slot] = np.arange(len(met))

        def each(rows: Float[np.ndarray, "frames rows"], filling: float) -> Float[np.ndarray, " meetings"]:
            return np.pad(rows[frame, met], (0, length - len(met)), constant_values=filling)

        probes = []
        for score, own in zip(self.score, skin.probes, strict=True):
            best = np.argsort(-score[: own.blend.shape[2]])
            probes.append(own[best[np.arange(PROBES) % len(best)]])
        frame_of, set_of = (np.pad(x, (0, length - len(met))) for x in (frame, met))
        return SkinContact(ProbeSets.of(probes), skin.fields, np.array(skin.field_of), frame_of, set_of, meeting_of,
                           each(smooth_floor(allowed, at.dt) - radius, 1e3), each(gap + radius, 1e3),
                           each(weight, 0.0))  # fmt: skip


def filled(rows: np.ndarray, at: Sampling, value: float) -> np.ndarray:
    return np.concatenate([rows, np.full((len(at.rows) - len(rows), rows.shape[1]), value)])

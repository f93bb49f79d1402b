"""How a motion stands: the `feet` and `balance` entries of report.json, for what a source clip shows as its plants."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from motionfit._character import Character
from motionfit._motion import Motion, bucket, continued, forward_kinematics
from motionfit._onto import onto
from motionfit._programs import program
from motionfit._types import InputError
from motionfit.balance import Soles, ZmpDistance, balance_measures, sole_boxes, zmp_distance
from motionfit.feet import Footplants, detect, find_sole, measure_feet
from motionfit.shape.mass import Masses, mass_volumes, mesh_masses, volume_masses


class Stance(NamedTuple):
    """When the source's feet are down: on the character (None without a sole), and on the body that says how balanced
    it was, which is the reference where there is one; with its distances there, where there is one."""

    plants: Footplants | None
    original: Footplants | None
    reference: ZmpDistance | None


def source_stance(
    character: Character, source: Motion, reference: Character | None = None, original: Motion | None = None
) -> Stance:
    """What a source clip, put on the character and (`original`) on a `reference`, says of standing."""
    plants = _plants(character, source)
    if reference is None or original is None:
        return Stance(plants, plants, None)
    own = _plants(reference, original)
    return Stance(plants, own, _distance(reference, original, own, own))


def measure_standing(character: Character, motion: Motion, stance: Stance) -> dict[str, dict | None]:
    """The `feet` and `balance` entries of a motion on a character.

    Feet are judged where the source has them down on the same character (`motionfit.feet.measure_feet`). The
    zero-moment point is that of the segment masses of the cut mesh with their spin, its support the sole boxes of
    the feet that the source has down, on the reference where there is one (`motionfit.balance`). None where a body
    has no sole, or encloses no volume to weigh.
    """
    feet = None if stance.plants is None else measure_feet(character, motion, stance.plants)
    distance = _distance(character, motion, stance.original, stance.plants)
    return {"feet": feet, "balance": None if distance is None else balance_measures(distance, stance.reference)}


def weighed(body: Character) -> tuple[Masses, Soles]:
    """Segment masses and sole boxes, kept with the body. Of a mesh that encloses nothing the segments still have
    girth and length."""
    if "weighed" not in body.memo:
        try:
            masses = mesh_masses(body)
        except InputError:
            masses = volume_masses(mass_volumes(body))
        body.memo["weighed"] = masses, sole_boxes(body)
    return body.memo["weighed"]


def _plants(character: Character, motion: Motion) -> Footplants | None:
    try:
        return detect(find_sole(character), onto(motion, character.skeleton))[0]
    except InputError:
        return None


def _distance(
    character: Character, motion: Motion, down: Footplants | None, own: Footplants | None
) -> ZmpDistance | None:
    """Distances of the ZMP where the feet are `down`, on the floor of the character's `own` plants."""
    if down is None or own is None:
        return None
    try:
        masses, soles = weighed(character)
    except InputError:
        return None
    return distances(character, motion, masses, soles, np.asarray(down.planted),
                     own.floor.at(np.asarray(motion.root, float)))  # fmt: skip


def distances(
    body: Character, motion: Motion, masses: Masses, soles: Soles, planted: Bool[np.ndarray, "frames 2"],
    ground: Float[np.ndarray, " frames"],
) -> ZmpDistance:  # fmt: skip
    """Distances of the ZMP in all frames of a clip that goes on past its end at the speed it has there: filled up to a
    bucket, so that clips share a program."""
    count = motion.frame_count
    seen, more = continued(motion, bucket(count)), bucket(count) - count
    found = zmp_distance(_kinematics(body.skeleton, seen), masses, soles, np.pad(planted, ((0, more), (0, 0))),
                         ground=np.pad(ground, (0, more), "edge"))  # fmt: skip
    return ZmpDistance(np.asarray(found.signed)[:count], np.asarray(found.supported)[:count])


@program
def _kinematics(skeleton, motion):
    return forward_kinematics(skeleton, motion)

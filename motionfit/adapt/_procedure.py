"""`adapt`: a clip and a character in, an adapted clip out. The whole procedure of thesis 5.2, block after block."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

from motionfit._character import Character
from motionfit._control import Correction
from motionfit._fit import Fit
from motionfit._motion import Motion, Source
from motionfit._onto import onto
from motionfit._problem import Problem
from motionfit._programs import make_room
from motionfit._types import InputError
from motionfit.adapt._balance import balance
from motionfit.adapt._collisions import MEANT, collisions, hands_meet
from motionfit.adapt._feet import footskate
from motionfit.adapt._forearm import forearm
from motionfit.adapt._limbs import LIMBS, limbs
from motionfit.adapt._limits import shown_between
from motionfit.metrics import TOLERANCE
from motionfit.shape.growth import grow
from motionfit.shape.pairs import pairs_of

Progress = Callable[[str, int, int], None]

LATER = {"forearm": forearm, "collisions": collisions, "footskate": footskate, "balance": balance}
BLOCKS = (*LIMBS, *LATER)
DEFAULT = ("arms", "legs", "footskate", "balance")  # the others cost more than they change on most clips
HOLDING = ("arms", "legs", "collisions", "footskate", "balance")  # of a clip whose hands meet something


def adapt(
    clip: Motion,
    character: Character,
    *,
    reference: Character | None = None,
    girth: Mapping[str, float] | None = None,
    blocks: Sequence[str] | None = None,
    objective: str = "vertex",
    sweeps: int = 1,
    start: Fit | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Adapt a clip to the shape of a character.

    The clip is put on the character (`motionfit.onto`), then the blocks run in the order of thesis 5.2: `arms` keeps
    upper arms, forearms and hands out of the trunk and the thighs, the left arm first, `legs` the thighs and calves
    apart; `forearm` brings the forearms back to where they pointed; `collisions` takes hands out of head, other arm
    and legs, and keeps touches that were meant; `footskate` keeps the planted feet where they are, by the root alone
    (without other blocks, it also stops what drift the source has itself);
    `balance` keeps the zero-moment point as near to the support as it was. Without `blocks`, `forearm` is left out, and
    so is `collisions`, but where a hand touches the head, the other arm or hand. Each has options of its own as
    `motionfit.adapt.forearm` and so on, which go on from a `Fit`. Penetration counts as far as it exceeds what the same
    clip shows on `reference`, the body that it was made for; without one, on the character before `girth`, else in
    its rest pose. A clip that was adapted to the same character before (`Motion.source`) is judged by what its source
    shows there, and what was adapted well comes back as it is.

    `start` is an earlier fit of the same clip, to a body that is alike: the solver starts from its correction.

    The `Fit` holds the adapted motion, the correction, what each block did, and in `details` what the blocks
    measured: see `motionfit.adapt.limbs`.
    """
    unknown = [b for b in blocks or () if b not in BLOCKS]
    if unknown or (blocks is not None and not blocks):
        raise InputError(f"unknown block {', '.join(map(repr, unknown)) or 'list'}; blocks: {', '.join(BLOCKS)}")
    if clip.frame_count == 0:
        raise InputError("the clip has no frames: it was cut to nothing; check its start and end")
    make_room()
    if girth:
        reference, character = reference or character, grow(character, girth)
    body = character.fingerprint
    adapted = clip.source_on(body) is not clip
    source, clip = (dataclasses.replace(m, source=None) for m in (clip.source_on(body), clip))
    base = onto(clip, character.skeleton)
    worth = MEANT if blocks is None else None  # by default a hand that misses a hip by a little costs no minute
    if blocks is None:
        blocks = HOLDING if hands_meet(source, reference or character) else DEFAULT
    first, later = (tuple(b for b in some if b in blocks) for some in (LIMBS, LATER))
    parts = bool(first) + len(later)

    def told(part: int, name: str, done: int, total: int) -> None:
        if progress is not None:
            progress(name, round(100 * (part + done / total) / parts), 100)

    if first:
        fit = limbs(clip, character, reference=reference, blocks=first, objective=objective, sweeps=sweeps,
                    start=start, source=source if adapted else None, progress=functools.partial(told, 0))  # fmt: skip
    else:
        fit = Fit(Correction((), ()), base, base, "converged", (), Problem(character, base, {}, ()))
    # what the source drifts is its own, unless nothing else is asked for
    options: dict[str, dict] = {"footskate": {"drift": tuple(blocks) == ("footskate",)}}
    for k, name in enumerate(later, start=bool(first)):
        if name == "collisions":
            options[name] = {"worth": worth, "progress": functools.partial(told, k, name)}
        fit = LATER[name](source, character, fit, reference=reference, **options.get(name, {}))
        told(k, name, 1, 1)
    if first and objective == "vertex" and fit.status == "converged":
        pairs, seen = pairs_of(*first), fit.details["frames"]
        if shown_between(source, character, reference, fit.motion, pairs, seen) > TOLERANCE:
            fit = dataclasses.replace(fit, status="violations_left")
    return dataclasses.replace(fit, motion=dataclasses.replace(fit.motion, source=Source(source, body)))


def arms(clip: Motion, character: Character, **options) -> Fit:
    """The arm block alone: thesis 4.4.1. Options as in `adapt`."""
    return adapt(clip, character, blocks=("arms",), **options)


def legs(clip: Motion, character: Character, **options) -> Fit:
    """The leg block alone: thesis 4.5. Options as in `adapt`."""
    return adapt(clip, character, blocks=("legs",), **options)

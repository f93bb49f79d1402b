"""Knees that do not snap where a foot is held: the hips give way by a millimetre or two.

In a capture the whole body trembles, legs and feet included: the knees hardly see it. A foot that is held does not
tremble any more, and what the hips still do is left to the knee, which near a straight leg turns by a degree for
each millimetre between hip and ankle. Only so much of it is taken from the hips as a knee would turn more abruptly
than it does around that moment in the clip.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.linalg import solveh_banded

from motionfit.feet._detect import smooth

AROUND = 0.1  # [s] over which a knee's own angular acceleration is averaged, to say what is abrupt for it
PRICE = 1.0  # [rad/m] of the hips' acceleration, in that of a knee: at a right angle a knee turns by 3.5 rad/m
BRIEF = 0.0125  # [s] what the hips give way for longer than this costs more than their acceleration: posture stays
IDLE = 0.1  # weight of the moments in which a knee is calm enough: with none, those of the next step swing to and fro
STEPS = 4  # within a hundredth of the least cost on every clip tried
STRAIGHT = 0.1  # sine of the bend below which a knee's gain no longer grows
NOTHING = 1e-6  # [m] less than this the hips need not give way: whoever follows them has fewer frames to solve
DIFFERENCE = (1.0, -2.0, 1.0)


def knee_bend(
    chord: Float[np.ndarray, "frames 3"], thigh: Float[np.ndarray, " frames"], shank: Float[np.ndarray, " frames"]
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, "frames 3"]]:
    """By how much a knee is bent [rad, 0 straight] when the ankle is `chord` [m] away from the hip, by the law of
    cosines, and how that changes with the chord [rad/m]. The lengths of thigh and shank are in [m]."""
    product = thigh * shank
    cosine = (np.einsum("fa,fa->f", chord, chord) - thigh**2 - shank**2) / (2 * product)
    bend = np.arccos(np.clip(cosine, -1.0, 1.0))
    return bend, -chord / (product * np.maximum(np.sin(bend), STRAIGHT))[:, None]


def calm_knees(
    chords: Sequence[Float[np.ndarray, "frames 3"]],
    source_chords: Sequence[Float[np.ndarray, "frames 3"]],
    bones: Sequence[tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]]],
    dt: float,
    price: float = PRICE,
) -> Float[np.ndarray, "frames 3"]:
    """How far [m] the hips should give way, given each leg's chord from hip to held ankle and the source's.

    The move c of least sum (excess of each knee's second difference)^2 + price^2 (|c''|^2 + |c|^2 / BRIEF^4), with
    differences for derivatives and `price` in [rad/m]. Excess is what goes beyond both the source knee's in the same
    frame and its root mean square `AROUND` there: so a leg that moves as in the source asks for nothing, and gets
    exactly that. Gauss-Newton, banded over time, `STEPS` long.
    """
    frames = len(chords[0])
    move = np.zeros((frames, 3))
    if frames < 3:
        return move
    width = 2 * round(0.5 * AROUND / dt) + 1
    bounds = []
    for chord, lengths in zip(source_chords, bones, strict=True):
        own = np.diff(knee_bend(chord, *lengths)[0], 2)
        bounds.append(np.maximum(np.abs(own), np.sqrt(np.maximum(smooth(own**2, width), 0.0))))
    own_place = (dt / BRIEF) ** 4
    for _ in range(STEPS):
        # normal equations of the hips' part, then of each knee's
        blocks = _normal_blocks(np.full((frames - 2, 1, 1), price**2), np.broadcast_to(np.eye(3), (frames, 3, 3)))
        blocks[0] += price**2 * own_place * np.eye(3)
        pull = -(price**2) * (_adjoint(np.diff(move, 2, axis=0)) + own_place * move)
        for chord, bound, lengths in zip(chords, bounds, bones, strict=True):
            bend, gain = knee_bend(chord - move, *lengths)
            turning = np.diff(bend, 2)
            excess = turning - np.clip(turning, -bound, bound)
            weight = np.where(excess != 0, 1.0, IDLE)[:, None, None]
            blocks += _normal_blocks(weight, gain[:, None])
            pull += gain * _adjoint(excess)[:, None]
        if not pull.any():
            break
        move = move + solveh_banded(_banded(blocks), pull.reshape(-1), lower=True).reshape(frames, 3)
    move[np.abs(move).max(1) < NOTHING] = 0.0
    return move


def _adjoint(x: Float[np.ndarray, "rows *rest"]) -> Float[np.ndarray, "frames *rest"]:
    """The transpose of second differences."""
    frames = np.zeros((len(x) + 2, *x.shape[1:]))
    for k, factor in enumerate(DIFFERENCE):
        frames[k : k + len(x)] += factor * x
    return frames


def _normal_blocks(
    weight: Float[np.ndarray, "rows 1 1"], gain: Float[np.ndarray, "frames r 3"]
) -> Float[np.ndarray, "3 frames 3 3"]:
    """G^T D^T W D G of second differences D of what a move of three components changes, as blocks between frames t
    and t + k."""
    rows = len(weight)
    blocks = np.zeros((3, len(gain), 3, 3))
    near = [np.swapaxes(gain[k:], 1, 2) @ gain[: len(gain) - k] for k in range(3)]
    for i in range(3):
        for j in range(i, 3):
            blocks[j - i, i : i + rows] += DIFFERENCE[i] * DIFFERENCE[j] * weight * near[j - i][i : i + rows]
    return blocks


def _banded(blocks: Float[np.ndarray, "3 frames 3 3"]) -> Float[np.ndarray, "9 unknowns"]:
    """The lower diagonals of a symmetric matrix whose blocks of three are given."""
    frames = blocks.shape[1]
    lower = np.zeros((9, frames, 3))
    for k, row, column in np.ndindex(3, 3, 3):
        if 3 * k + row >= column:
            lower[3 * k + row - column, :, column] += blocks[k, :, row, column]
    return lower.reshape(9, 3 * frames)

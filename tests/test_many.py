"""One clip on many bodies."""

from typing import Any

import numpy as np
import pytest

import motionfit as mf
from motionfit import samples

pytestmark = pytest.mark.slow
ARMS: dict[str, Any] = {"blocks": ("arms",)}


@pytest.fixture(scope="module")
def walk():
    return samples.walk(cycles=1)


def test_each_starts_from_the_last_and_comes_in_order(walk, average):
    bodies = [mf.shape.grow(average, {"arms": g, "trunk": g}) for g in (1.2, 1.3, 1.3)]
    told: list[int] = []
    fits = list(mf.adapt_many(walk, bodies, reference=average, workers=1, progress=told.append, **ARMS))
    assert told == [1, 2, 3]
    alone = mf.adapt(walk, bodies[0], reference=average, **ARMS)
    assert np.array_equal(fits[0].motion.rotations, alone.motion.rotations)
    after = mf.adapt(walk, bodies[1], reference=average, start=alone, **ARMS)
    assert np.array_equal(fits[1].motion.rotations, after.motion.rotations)
    assert all(np.maximum(f.details["excess_after_m"], 0).max() < 0.01 for f in fits)


def test_bodies_are_made_when_they_are_needed(walk, average):
    made: list[float] = []

    def bodies():
        for girth in np.linspace(1.0, 1.1, 6):
            made.append(girth)
            yield mf.shape.grow(average, {"arms": float(girth)})

    fits = mf.adapt_many(walk, bodies(), reference=average, workers=2, **ARMS)
    next(fits)
    assert len(made) == 1
    next(fits)
    assert len(made) <= 3
    assert len(list(fits)) == 4


def test_a_start_of_another_clip_is_refused(walk, average):
    fit = mf.adapt(walk, average, reference=average, **ARMS)
    with pytest.raises(mf.InputError, match="start= is a fit of another clip"):
        mf.adapt(walk[:20], average, reference=average, start=fit, **ARMS)
    with pytest.raises(mf.InputError, match="other blocks"):
        mf.adapt(walk, average, reference=average, start=fit, blocks=("legs",))


def test_a_start_may_hold_controls_of_later_blocks(walk, heavy, average):
    bodies = [heavy, mf.shape.grow(heavy, {"trunk": 1.02})]
    first, second = mf.adapt_many(walk, bodies, reference=average, workers=1)
    # the block adds controls where it has something to do, as it has on a heavy body
    assert first.details["balance"]["zmp_distance_before_m"] > first.details["balance"]["zmp_distance_after_m"]
    assert len(first.correction.controls) > 8 and second.status == "converged"

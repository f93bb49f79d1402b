"""The rounds of `collisions`: what a round asks for next, by what a result is judged, and which start is gone on with."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from motionfit._motion import rest_motion
from motionfit.adapt._asked import Asked
from motionfit.adapt._collisions import ASUNDER, CALMER, ROUNDS, TOO_ROUGH, TRIAL, WELL, Attempt, Shown, _best
from motionfit.adapt._easing import ROUGHER
from motionfit.adapt._groups import GROUPS, known_depths
from motionfit.adapt._limits import SkinLooks
from motionfit.shape.pairs import PAIRS


def test_rounds_end_where_they_are_of_no_more_use():
    attempt = object.__new__(Attempt)
    attempt.done, attempt.rounds = False, 0
    for shown, stale in (([], False), ([1.0, 0.5, 0.2], False), ([0.5, 0.49, 0.48, 0.47], True),
                         ([0.5, 0.6, 0.7, 0.4], False), ([0.0, 0.0, 0.0, 0.0], True)):  # fmt: skip
        attempt.shown = shown
        assert attempt._stale() is stale
    told = []
    attempt.done, attempt.shown = True, []
    attempt.go_on(ROUNDS, lambda: told.append(1))
    assert told == []


def _rounds_that_show(shown, rough, rounds, monkeypatch):
    """An attempt whose rounds all show the same, and are rougher than they may be by so much."""
    attempt: Any = object.__new__(Attempt)
    rows, points = np.zeros((4, 1)), iter(range(rounds))
    attempt.asked = SimpleNamespace(touching=np.ones((4, 1), bool), allowed=rows + 0.004, own=rows, so_far=None)
    attempt.result, attempt.faults, attempt.shown, attempt.history = None, np.inf, [], ()
    attempt.rounds, attempt.smooth, attempt.meetings = ROUNDS, 1.0, SimpleNamespace(seen=lambda *_: None)
    attempt.allowed, attempt.gap, attempt.points = rows + 0.004, rows + 0.012, None
    attempt._solved, attempt.judged = lambda: (next(points), ()), lambda result: shown
    monkeypatch.setattr("motionfit.adapt._collisions.rougher", lambda *_: rough)
    for _ in range(rounds):
        attempt._round()
        yield attempt


def _shows(over=0.0, apart=0.0, on_skin=(0.0,), shares=(1.0,)):
    rows = np.zeros((4, 1))
    return Shown(rows[..., None], rows, rows, rows + over, rows + apart, np.array(on_skin)[:, None], np.array(shares))


def test_what_cannot_be_had_is_not_asked_for_ever_more(monkeypatch):
    seen = [(float(a.allowed[0, 0]), float(a.gap[0, 0]))
            for a in _rounds_that_show(_shows(0.05, 0.05), 0.0, 6, monkeypatch)]  # fmt: skip
    np.testing.assert_allclose(seen[0], (-0.016, -0.008), atol=1e-12)
    np.testing.assert_allclose(seen[-1], (-0.026, -0.018), atol=1e-12)


@pytest.mark.parametrize(
    ("rough", "smooth", "result"),
    [
        (ROUGHER / 2, 1.0, 2),
        (2 * ROUGHER, CALMER**3, None),
    ],
)
def test_only_what_is_too_rough_to_be_taken_gets_calmer(rough, smooth, result, monkeypatch):
    *_, attempt = _rounds_that_show(_shows(apart=0.05), rough, 3, monkeypatch)
    assert attempt.smooth == pytest.approx(smooth)
    assert attempt.result == result  # of equals the last one
    assert attempt.prospect == pytest.approx(_shows(apart=0.05).faults + max(rough - ROUGHER, 0.0) / TOO_ROUGH)


def test_a_fault_counts_as_the_frames_that_its_look_stands_for():
    seldom, often = _shows(on_skin=(0.01, -0.01), shares=(0.2, 0.8)), _shows(on_skin=(0.01,) * 2 + (-0.01,) * 2,
                                                                              shares=(0.1, 0.1, 0.4, 0.4))  # fmt: skip
    assert seldom.faults == pytest.approx(0.4) and often.faults == pytest.approx(seldom.faults)
    assert _shows(over=0.02).faults == pytest.approx(2.0) and _shows(over=0.009).faults == 0.0
    assert 1.0 < _shows(apart=1e-6).faults < 1.001 and _shows(apart=ASUNDER / 2).faults == pytest.approx(1.5)
    assert _shows(apart=1.0).faults == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("faults", "results", "taken"),
    [((0.4, 0.1), (1, 2), 2), ((0.1, 0.4), (1, 2), 1), ((0.01, 0.0), (1, 2), 1), ((0.1, 0.4), (None, 2), 2),
     ((0.1, 0.6), (None, 2), None)],
)  # fmt: skip
def test_of_two_starts_the_better_one_is_taken_and_the_other_where_it_comes_to_nothing(
    faults, results, taken, average, monkeypatch
):
    """`faults` are those after the first rounds and `results` what they come to, without a correction and with it."""
    made, went_on = [], []

    class Start:
        done, rounds, history = False, 0, ()

        def __init__(self, asked, start, looks):
            self.at = len(made)
            self.looks, self.result, self.prospect = looks, results[self.at], faults[self.at]
            self.faults = max(self.prospect, 2 * WELL)  # what the skin shows needs no other start
            made.append(start)

        def go_on(self, rounds, tell):
            went_on.append((self.at, rounds))

        def look_between(self):
            return False

        def judged(self, result):
            return _shows()

    monkeypatch.setattr("motionfit.adapt._collisions.Attempt", Start)
    monkeypatch.setattr("motionfit.adapt._collisions.without_arms", lambda fit: "without arms")
    monkeypatch.setattr("motionfit.adapt._collisions.sinking_skin", lambda *_: None)
    monkeypatch.setattr("motionfit.adapt._collisions.eased", lambda name, so_far, result, *_: result)
    fit: Any = SimpleNamespace(motion=rest_motion(average.skeleton))
    asked = Asked._make([average, fit, SimpleNamespace(motion=lambda m: m), *[None] * 6, True])
    looks: Any = object.__new__(SkinLooks)
    monkeypatch.setattr(SkinLooks, "anew", lambda self: self)
    assert _best(asked, 0.5, True, looks, lambda: None).fit == taken
    if faults[0] < WELL:
        assert made == [fit] and went_on == [(0, TRIAL), (0, ROUNDS)]
    else:
        assert made == [fit, "without arms"] and went_on[:2] == [(0, TRIAL), (1, TRIAL)]
        first = int(np.argmin(faults))
        assert went_on[2:] == [(first, ROUNDS), (1 - first, ROUNDS)][: 1 if results[first] else 2]
    made.clear()
    _best(asked, 0.5, False, looks, lambda: None)  # no touch was lost
    assert made == [fit]


def test_the_skin_of_what_touches_is_looked_at_once(average):
    known = known_depths(average, GROUPS)
    touching = np.zeros((4, len(known.clearance.pairs)), bool)
    asked = Asked._make([*[None] * 3, known, *[None] * 4, touching, True])
    assert asked.looked_at == PAIRS
    names = [p.name for p in known.clearance.pairs]
    for name in ("left_hand/right_hand", "right_hand/left_hand", "left_hand/head", "left_hand/torso"):
        touching[2, names.index(name)] = True
    assert [p.name for p in asked.looked_at[len(PAIRS) :]] == ["left_hand/head", "left_hand/right_hand"]

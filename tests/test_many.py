"""One clip on many bodies."""

import os
import pickle
import subprocess
import sys
from itertools import islice
from typing import Any

import numpy as np
import pytest

import motionfit as mf
from benchmarks.metrics import compilations
from motionfit import samples
from motionfit.adapt._many import _shared_folder

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


def test_a_body_from_another_process_compiles_nothing(walk, average):
    """A worker gets bodies and starts by pickle: traced anew for each, it grew by 200 MB per body."""
    bodies = [mf.shape.grow(average, {"arms": g, "trunk": g}) for g in (1.2, 1.3, 1.4)]
    first = mf.adapt(walk, pickle.loads(pickle.dumps(bodies[0])), reference=average, **ARMS)
    start = mf.adapt(walk, pickle.loads(pickle.dumps(bodies[1])), reference=average, start=first, **ARMS)
    body, start = pickle.loads(pickle.dumps((bodies[2], start)))
    assert compilations(lambda: mf.adapt(walk, body, reference=average, start=start, **ARMS).status) == 0


def test_bodies_are_made_when_they_are_needed(walk, average, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("motionfit._traces._folder", None)  # another test may have named one
    _shared_folder.cache_clear()
    made: list[mf.Character] = []

    def bodies():
        for girth in np.linspace(1.2, 1.4, 8):
            made.append(mf.shape.grow(average, {"arms": float(girth), "trunk": float(girth)}))
            yield made[-1]

    fits = mf.adapt_many(walk, bodies(), reference=average, workers=2, **ARMS)
    first = next(fits)
    assert len(made) == 1
    second = next(fits)
    assert len(made) <= 5
    every = [first, second, *fits]
    assert len(every) == len(made) == 8
    for fit, body in zip(every, made, strict=True):
        assert np.array_equal(fit.problem.character.skin.vertices_bind, body.skin.vertices_bind)
        assert np.maximum(fit.details["excess_after_m"], 0).max() < 0.01
    # what the workers share stays for the next call, which traces nothing anew
    traces = sorted(tmp_path.glob("motionfit-*/*.trace"))
    made.clear()
    assert len(list(islice(mf.adapt_many(walk, bodies(), reference=average, workers=2, **ARMS), 2))) == 2
    assert sorted(tmp_path.glob("motionfit-*/*.trace")) == traces != []
    _shared_folder.cache_clear()


def test_a_script_needs_no_guard_and_an_error_names_itself(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import motionfit as mf\n"
        "from motionfit import samples\n"
        "average = mf.load_character('builtin:average')\n"
        "try:\n"
        "    list(mf.adapt_many(samples.walk(cycles=1), [average] * 2, reference=average, blocks=('wings',), workers=2))\n"
        "except mf.InputError as error:\n"
        "    print(error)\n"
    )
    place = {**os.environ, "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, env=place)
    assert done.returncode == 0, done.stderr
    assert "wings" in done.stdout and len(done.stdout.splitlines()) == 1
    assert not list(tmp_path.glob("motionfit-*"))


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

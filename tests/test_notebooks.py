"""The notebooks and the README's first example run top to bottom, and show what they say."""

import itertools
import pathlib
import re
import runpy

import numpy as np
import pytest

import motionfit as mf
from motionfit import samples
from motionfit.metrics import TOLERANCE

ROOT = pathlib.Path(__file__).parents[1]
NOTEBOOKS = ROOT / "notebooks"

pytestmark = pytest.mark.slow


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Execute a notebook without a display, in a folder of its own; returns its names and the figures it drew."""
    import matplotlib

    monkeypatch.setenv("MPLBACKEND", "Agg")
    matplotlib.use("Agg")  # another test may have imported it already
    import matplotlib.pyplot as plt

    monkeypatch.chdir(tmp_path)

    def execute(name: str) -> tuple[dict, list]:
        plt.close("all")
        names = runpy.run_path(str(NOTEBOOKS / name))
        figures = [plt.figure(number) for number in plt.get_fignums()]
        for figure in figures:
            figure.canvas.draw()
        return names, figures

    yield execute
    plt.close("all")


def _has_ink(figure) -> bool:
    return all(len(np.unique(np.asarray(figure.canvas.buffer_rgba())[..., k])) > 10 for k in range(3))


def test_every_notebook_is_executed_here():
    text = pathlib.Path(__file__).read_text()
    names = sorted(p.name for p in NOTEBOOKS.glob("*.py"))
    assert len(names) >= 3 and all(f'run("{name}")' in text for name in names)


def test_first_fit(run, tmp_path):
    names, figures = run("01_first_fit.py")
    before, half, after = (names["on_skin"][k].max() for k in ("before", "half", "after"))
    assert after < TOLERANCE < half < before
    assert names["fit"].status == "converged" and names["after"].max() < TOLERANCE < names["before"].max()
    assert np.array_equal(names["again"].rotations, names["fit"].motion.rotations)
    assert mf.load_motion(tmp_path / "adapted.glb").frame_count == names["clip"].frame_count
    assert len(figures) == 2 and all(_has_ink(f) for f in figures)


def test_own_term(run):
    names, figures = run("02_your_own_term.py")
    excess, fits = names["excess"], names["fits"]
    assert excess["weight 10"] < excess["least squares"] < 0.5 * names["skin_excess"](names["base"])
    assert {f.status for f in fits.values()} == {"converged"}
    one, other = (fits[k].history[0].cost_after for k in ("least squares", "dense LM"))
    assert abs(one - other) < 1e-3 * one
    assert abs(names["quotient"] - names["by_radius"]) < 1e-2 * names["by_radius"]  # a difference over 4 mm
    again = {"another weight", "another radius and c", "another body"}
    assert {k for k, count in names["compiled"].items() if count == 0} == again
    assert len(figures) == 1 and _has_ink(figures[0])


def test_footskate(run, tmp_path):
    names, figures = run("03_footskate.py")
    slides, fits = names["slides"], names["fits"]
    assert slides["before"] > 0.05 and slides["leg-ik"] < 0.1 * slides["before"] and slides["root"] < 1e-6
    assert fits["root"].motion.rotations is fits["root"].base.rotations
    assert names["labelled"].status == "converged" and (tmp_path / "plants.csv").exists()
    assert len(figures) == 2 and all(_has_ink(f) for f in figures)


def test_readme_example(tmp_path, monkeypatch, heavy, average):
    """As it is printed, but for two of its nine girths."""
    found = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    monkeypatch.chdir(tmp_path)
    walk, many, seen = samples.walk(cycles=1), mf.adapt_many, []
    mf.save("walk.bvh", walk)
    for body in (heavy, average):
        mf.save(f"{body.name.removeprefix('builtin:')}.glb", mf.onto(walk, body.skeleton), body)

    def some(clip, bodies, **options):
        for fit in many(clip, itertools.islice(bodies, 2), **options):
            seen.append(fit)
            yield fit

    monkeypatch.setattr(mf, "adapt_many", some)
    names = {"__name__": "readme"}
    exec(compile(found[1], "README.md", "exec"), names)
    assert mf.load_motion("adapted.glb").frame_count == walk.frame_count
    # one fit is the first, of which the file was written; the others are of the grown bodies
    assert len(seen) == 2 and names["fit"] is seen[-1] and {f.status for f in seen} == {"converged"}
    again = mf.load_correction("c.npz")
    adapted = mf.onto(mf.load_motion("adapted.glb"), heavy.skeleton)
    assert np.abs(again["left_arm"]).max() > np.deg2rad(5)
    assert mf.metrics.joint_angle_deviation(adapted, mf.onto(walk, heavy.skeleton))[1] > np.deg2rad(5)

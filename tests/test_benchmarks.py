"""The gate: what counts as a regression, what does not, and that the entries really yield what the baseline holds."""

import importlib.util
import json
import pathlib

import jax
import numpy as np
import pytest

import motionfit as mf
from benchmarks import __main__ as command
from benchmarks import finite_differences, metrics, peers, profile, workloads
from benchmarks.metrics import BASELINE, FIELDS, Metric, compare, interleaved, load_baseline, save_baseline
from benchmarks.workloads import Entry, Skip
from motionfit import samples


def _table(**changes):
    row = {"value": 2.0, "unit": "m", "direction": "lower", "tolerance": 0.1, "slack": 0.0, "timed": False,
           "device": "cpu: some", "jax": "0"}  # fmt: skip
    return {"walk.left": row | changes}


@pytest.mark.parametrize(
    ("direction", "better", "bound", "worse"),
    [("lower", 1.0, 2.19, 2.21), ("higher", 3.0, 1.81, 1.79), ("equal", 2.0, 2.19, 1.79)],
)
def test_compare_knows_directions_and_tolerances(direction, better, bound, worse):
    for value, regressed in ((better, False), (bound, False), (worse, True), (float("nan"), True)):
        found = compare(_table(direction=direction), [Metric("walk.left", value, "m", direction, 0.1)])
        assert bool(found) == regressed, (direction, value)
    assert found[0].key == "walk.left" and found[0].baseline == 2.0 and found[0].tolerance == 0.1
    assert all(word in str(found[0]) for word in ("walk.left", "baseline 2 m", "10%"))


def test_compare_by_the_committed_tolerance_and_slack():
    # the running code may not loosen itself
    assert compare(_table(tolerance=0.0), [Metric("walk.left", 2.1, "m", "lower", 10.0)])
    assert not compare(_table(tolerance=0.0, slack=0.2), [Metric("walk.left", 2.1, "m", "lower", 0.0)])
    # what is not gated, and what is new
    assert not compare(_table(tolerance=None), [Metric("walk.left", 9.0, "m")])
    assert not compare({}, [Metric("walk.left", 9.0, "m", "lower", 0.0)])


def test_a_metric_that_disappeared_is_a_regression_but_a_skipped_entry_is_not():
    gone = compare(_table(), [Metric("walk.other", 1.0, "m")])
    assert gone[0].now is None and "missing" in str(gone[0])
    assert not compare(_table(), [Metric("run.other", 1.0, "m")])


def test_times_of_another_platform_are_not_compared():
    slow = [Metric("walk.left", 9.0, "ratio", "lower", 0.1, 0.0, True)]
    assert compare(_table(timed=True), slow, "cpu")
    assert not compare(_table(timed=True), slow, "gpu")
    assert compare(_table(timed=False), slow, "gpu")


def test_save_baseline_replaces_an_entry_and_keeps_the_others(tmp_path):
    path = tmp_path / "baseline.json"
    save_baseline(path, [Metric("walk.left", 1.0, "m"), Metric("walk.old", 1.0, "m"), Metric("run.left", 1.0, "m")])
    save_baseline(path, [Metric("walk.left", 3.0, "m", "higher", 0.5)])
    table = load_baseline(path)
    assert set(table) == {"walk.left", "run.left"} and table["walk.left"]["value"] == 3.0
    with pytest.raises(ValueError, match="cannot be a baseline"):
        save_baseline(path, [Metric("walk.left", float("inf"), "m")])
    path.write_text(json.dumps({"schema": 0, "metrics": {}}))
    with pytest.raises(ValueError, match="schema 0"):
        load_baseline(path)


def test_committed_baseline_has_the_schema_and_names_known_entries():
    table = load_baseline(BASELINE)
    known = {e.name for e in workloads.entries()}
    for key, row in table.items():
        assert key.partition(".")[0] in known, f"{key} is of no entry: run --update-baseline"
        assert set(row) == set(FIELDS)
        assert row["direction"] in ("lower", "higher", "equal") and np.isfinite(row["value"])
        assert row["tolerance"] is None or row["tolerance"] >= 0
        # seconds are for reading: another machine has others
        assert row["unit"] not in ("s", "ms", "us", "ms/frame", "us/frame", "s/shape") or row["tolerance"] is None
    text = BASELINE.read_text(encoding="utf-8")
    assert not any(mark in text for mark in ("/home", "/root", "/work", "/tmp", "C:\\\\"))


def test_interleaved_ratio_is_steady_on_a_machine_that_others_load(monkeypatch):
    """On a clock of its own: the machine gets slower all the time, and three rounds are hit by something else."""
    now, calls = [0.0], [0]

    def work(seconds):
        def run():
            calls[0] += 1
            hit = 50.0 if calls[0] in (9, 14, 21) else 1.0
            now[0] += seconds * (1.0 + 0.01 * calls[0]) * hit

        return run

    monkeypatch.setattr("benchmarks.metrics.time.perf_counter", lambda: now[0])
    pace = interleaved(work(0.4), work(0.1), rounds=11, budget_s=1e6)
    assert pace.ratio == pytest.approx(4.0, rel=0.02)
    assert pace.run_s / pace.reference_s == pytest.approx(4.0, rel=0.2)


def test_naive_numpy_and_fast_kinematics_agree_with_helper_joints():
    walk = workloads.clip_of(5)
    skeleton, motion = workloads._with_joints(walk.skeleton, walk, 80)
    assert len(skeleton.names) == 80 and dict(skeleton.roles) == dict(walk.skeleton.roles)
    oracle, _ = metrics.numpy_kinematics(skeleton.parents, skeleton.offsets, motion.root, motion.rotations)
    for kinematics in (workloads._ours, workloads.naive_kinematics):
        np.testing.assert_allclose(kinematics(skeleton, motion), oracle, atol=1e-9)


@pytest.mark.filterwarnings("ignore:Explicitly requested dtype")
def test_cheap_entries_yield_what_the_baseline_holds(monkeypatch):
    monkeypatch.setattr(workloads, "interleaved", lambda a, b, **_: (a(), b(), metrics.Pace(1.0, 1.0, 1.0))[2])
    baseline = load_baseline(BASELINE)
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
        for name, entry in (("fk", workloads.fk), ("fk-gradient", workloads.fk_gradient), ("skin", workloads.skin)):
            found = list(entry(20))
            assert {m.key for m in found} == {k for k in baseline if k.partition(".")[0] == name}
            assert all(np.isfinite(m.value) for m in found)
            assert {m.key: m.value for m in found}[f"{name}.error"] < 1e-4


def test_girths_are_the_grid_of_the_thesis():
    grid = workloads.girths(243)
    assert len({tuple(g.values()) for g in grid}) == 243
    assert workloads.girths(1) == [grid[121]] and len(workloads.girths(8)) == 8


# --- the command line ------------------------------------------------------------------------------------------


@pytest.fixture
def toy(monkeypatch):
    """Entries that cost nothing: a steady one, one that is slow the first time, one that cannot run here."""
    calls = []

    def steady():
        yield Metric("steady.left", 1.0, "m", "lower", 0.1)

    def noisy():
        calls.append(1)
        yield Metric("noisy.time", 9.0 if len(calls) == 1 else 1.0, "ratio", "lower", 0.5, 0.0, True)

    def absent():
        raise Skip("no such library")
        yield

    table = (Entry("steady", steady, "a"), Entry("noisy", noisy, "b"), Entry("absent", absent, "c"),
             Entry("huge", absent, "d", heavy=True))  # fmt: skip
    monkeypatch.setattr(command, "entries", lambda: table)
    return calls


def _baseline(path, **values):
    rows = [Metric("steady.left", 1.0, "m", "lower", 0.1), Metric("noisy.time", 1.0, "ratio", "lower", 0.5, 0.0, True),
            Metric("absent.left", 1.0, "m", "lower", 0.0)]  # fmt: skip
    save_baseline(path, [m for m in rows])
    table = json.loads(path.read_text())
    for key, value in values.items():
        table["metrics"][key.replace("_", ".")]["value"] = value
    path.write_text(json.dumps(table))
    return ["--baseline", str(path)]


def test_gate_passes_on_noise_and_fails_on_a_regression(toy, tmp_path, capsys):
    assert command.main([*_baseline(tmp_path / "b.json"), "--gate"]) == 0
    said = capsys.readouterr().out
    assert "measured again" in said and "skipped: no such library" in said and "nothing regressed" in said
    assert len(toy) == 2
    # the committed number was better: what the code does now is a regression
    assert command.main([*_baseline(tmp_path / "b.json", steady_left=0.5), "--gate"]) == 1
    said = capsys.readouterr().out
    assert "steady.left: baseline 0.5 m, now 1, allowed 0.55 (tolerance 10%)" in said
    # without --gate it is only shown
    assert command.main(_baseline(tmp_path / "b.json", steady_left=0.5)) == 0


def test_a_time_that_stays_slow_is_a_regression(toy, tmp_path, capsys):
    assert command.main([*_baseline(tmp_path / "b.json", noisy_time=0.1), "--gate", "-k", "noisy"]) == 1
    assert len(toy) == 3 and "noisy.time: baseline 0.1" in capsys.readouterr().out


def test_update_baseline_then_gate(toy, tmp_path):
    path = ["--baseline", str(tmp_path / "new.json"), "-k", "steady"]
    assert command.main([*path, "--update-baseline"]) == 0
    assert command.main([*path, "--gate"]) == 0


@pytest.mark.parametrize(
    ("arguments", "told"),
    [(["-k", "nose"], "entries: steady, noisy, absent, huge"), (["--gate", "--update-baseline"], "choose one"),
     (["--gate", "--baseline", "missing.json"], "no baseline")],
)  # fmt: skip
def test_bad_usage_is_status_2(toy, arguments, told, capsys):
    with pytest.raises(SystemExit) as stopped:
        command.main(arguments)
    assert stopped.value.code == 2 and told in capsys.readouterr().err


def test_an_entry_that_fails_fails_the_run_and_writes_no_baseline(toy, tmp_path, monkeypatch, capsys):
    def broken():
        yield Metric("broken.left", 1.0, "m")
        raise ZeroDivisionError("as it happens")

    monkeypatch.setattr(command, "entries", lambda: (Entry("broken", broken, "e"),))
    assert command.main(["--baseline", str(tmp_path / "b.json"), "--update-baseline"]) == 1
    assert "as it happens" in capsys.readouterr().out and not (tmp_path / "b.json").exists()


def test_heavy_entries_run_only_when_named():
    table = workloads.entries()
    default = {e.name for e in command.select([], False, table)}
    assert "fk" in default and not default & {"frames-30000", "shapes-243", "finite-differences", "peer-mink"}
    assert [e.name for e in command.select(["shapes-243"], False, table)] == ["shapes-243"]
    assert {e.name for e in command.select(["fk*"], False, table)} == {"fk", "fk-gradient"}
    assert len(command.select([], True, table)) == len(table)


# --- the solvers and the peers ---------------------------------------------------------------------------------


def test_flat_objective_is_the_cost_of_the_block():
    problem, block = finite_differences.arm_problem(12)
    assert len(problem.controls) == 4 and block.controls == tuple(c.name for c in problem.controls)
    low, high = finite_differences.bounds(problem)
    x = np.random.default_rng(0).uniform(-0.1, 0.1, len(low))
    assert (low < x).all() and (x < high).all()
    counts = np.cumsum([c.basis.count for c in problem.controls])[:-1]
    correction = workloads.mf.Correction(problem.controls, tuple(np.split(x, counts)))
    total = sum(problem.costs(correction).values())
    assert total > 1
    np.testing.assert_allclose(jax.jit(finite_differences.flat_objective(problem))(x), total, rtol=1e-9)


def test_solver_table_says_who_did_not_arrive():
    rows = [finite_differences.Outcome("lm-banded", 75, 60, 0.1, 2.0, 9),
            finite_differences.Outcome("slsqp-differences", 75, 60, 60.0, 3.0, 999, capped=True),
            finite_differences.Outcome("lm-qr", 75, 60, np.nan, np.nan, 0, skipped="not run above 60 frames")]  # fmt: skip
    text = finite_differences.table(rows)
    assert "capped, DID NOT REACH" in text and ">600" in text and "not run above 60 frames" in text
    keys = {m.key: m for m in finite_differences._metrics("s", rows, 1.0)}
    assert keys["s.lm-banded_75_cost_over_best"].value == 1.0
    assert keys["s.lm-banded_over_slsqp-differences_75"].tolerance is None  # its time is the cap's, not its own


def test_peers_skip_with_a_reason(monkeypatch):
    monkeypatch.delenv("MOMENTUM_PYTHON", raising=False)
    monkeypatch.setattr(peers.shutil, "which", lambda name: None)
    with pytest.raises(RuntimeError, match="Python 3.12 with pymomentum-cpu"):
        peers._interpreter("momentum")
    if importlib.util.find_spec("mink") is None:
        monkeypatch.delenv("MINK_PYTHON", raising=False)
        with pytest.raises(RuntimeError, match="MINK_PYTHON"):
            peers._interpreter("mink")


def test_peer_work_is_judged_by_the_allowed_depth():
    work = peers.builtin_work(4)
    row = peers.untouched(work)
    assert row.worst_m > 0.01 and row.over_1cm == 1.0 and row.deviation_rad == 0.0
    assert "untouched" in peers.table([row])


@pytest.mark.slow
def test_a_profile_finds_every_block_and_kind_of_work(heavy, average):
    """They are found by name: one that is called otherwise some day would silently take no time."""
    total, spent = profile.profiled(samples.walk(cycles=1), heavy, average)
    absent = {"collisions", "gaps of touches"}  # no hand touches anything
    assert {name for name, seconds in spent.items() if seconds == 0.0} == absent
    for some in (profile.BLOCKS, profile.WORK):
        assert 0.5 * total < sum(spent[name] for name in some) <= total
    for name in absent:
        file, function = {**profile.BLOCKS, **profile.WORK}[name]
        assert any(f"\ndef {function}(" in p.read_text() for p in pathlib.Path(mf.__file__ or "").parent.rglob(file))

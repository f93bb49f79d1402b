"""Other libraries on the same work: the same clip, the same capsules, the same depth that does not count.

    python -m benchmarks.peers [mink momentum] [--frames 300] [--data FOLDER --clip bvh/02_01_walk --body heavy_male]

Each peer runs in a process of its own, so that it can have an environment of its own: what it needs goes there in an
.npz file, and the poses that it makes come back and are judged here, by one ruler. MINK_PYTHON and MOMENTUM_PYTHON name
the interpreters that have the packages `mink` (with a QP solver: `mink daqp`) and `pymomentum-cpu`; without them mink is
looked for in this environment, and momentum where a python3.12 is on the path.
"""

import argparse
import functools
import json
import math
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass

import jax
import numpy as np

import motionfit as mf
from benchmarks.metrics import Metric, fixed_work, interleaved, seconds
from motionfit import samples
from motionfit.adapt import build_clearance, volume_depths
from motionfit.adapt._clearance import Clearance
from motionfit.metrics import TOLERANCE, derivative_ratio, joint_angle_deviation
from motionfit.shape.pairs import PAIRS

FRAMES = 300


@dataclass(frozen=True)
class Work:
    """A clip on a body, its capsules, and the depth [m] per frame and pair that the reference body shows anyway."""

    motion: mf.Motion
    character: mf.Character
    reference: mf.Character
    clearance: Clearance
    allowed: np.ndarray

    def excess(self, motion: mf.Motion) -> np.ndarray:
        """What counts as penetration [m], per frame and pair."""
        return np.maximum(volume_depths(self.clearance, motion) - self.allowed, 0.0)


def work_of(clip: mf.Motion, character: mf.Character, reference: mf.Character) -> Work:
    """The capsules of `motionfit.shape.fit_volumes`, in the pairs that motionfit keeps apart."""
    clearance = build_clearance(character, PAIRS, "capsule")
    own = build_clearance(reference, PAIRS, "capsule")
    allowed = volume_depths(own, mf.onto(clip, reference.skeleton))
    return Work(mf.onto(clip, character.skeleton), character, reference, clearance, allowed)


def builtin_work(frames: int = FRAMES) -> Work:
    """The built-in walk on the built-in heavy body."""
    average, heavy = (mf.load_character(f"builtin:{name}") for name in ("average", "heavy"))
    return work_of(samples.walk(cycles=-(-frames // 60))[:frames], heavy, average)


@dataclass(frozen=True)
class Judged:
    """How one library did: seconds per frame of solve and forward kinematics, and the motion that came out."""

    name: str
    frame_s: float
    fk_frame_s: float
    worst_m: float
    over_1cm: float
    deviation_rad: float
    jerk_ratio: float
    pairs_left: str
    note: str


def judge(name: str, work: Work, motion: mf.Motion, frame_s: float, fk_frame_s: float, note: str) -> Judged:
    """Penetration left and closeness to the source, by the same measures for all."""
    excess = work.excess(motion)
    left = [p.name for p, worst in zip(work.clearance.pairs, excess.max(axis=0), strict=True) if worst > TOLERANCE]
    return Judged(
        name, frame_s, fk_frame_s, float(excess.max()), float((excess > TOLERANCE).any(1).mean()),
        joint_angle_deviation(motion, work.motion)[0], derivative_ratio(motion, work.motion, 3) or math.nan,
        ", ".join(left) if len(left) <= 4 else f"{len(left)} pairs", note,
    )  # fmt: skip


def ours(work: Work) -> Judged:
    """motionfit with the capsule objective, warm: what `adapt` takes as a whole, per frame."""
    run = functools.partial(mf.adapt, work.motion, work.character, reference=work.reference, objective="capsule")
    fit = run()
    frames = work.motion.frame_count
    pace = interleaved(run, fixed_work(), rounds=5)
    fk = jax.jit(lambda motion: mf.forward_kinematics(motion.skeleton, motion).positions_world)
    device = jax.tree.map(lambda x: jax.numpy.asarray(x) if isinstance(x, np.ndarray) else x, work.motion)
    fk_pace = interleaved(lambda: fk(device), fixed_work(), rounds=9)
    return judge("motionfit", work, fit.motion, pace.run_s / frames, fk_pace.run_s / frames, "all blocks, warm")


def untouched(work: Work) -> Judged:
    """The clip as it is."""
    return judge("untouched", work, work.motion, 0.0, 0.0, "")


def run_peer(name: str, work: Work, timeout_s: float = 1800.0) -> Judged:
    """Run a peer's script on the work. A `RuntimeError` with the reason where it cannot be had here."""
    python = _interpreter(name)
    script = pathlib.Path(__file__).parent / f"peer_{name}.py"
    term = work.clearance.term
    volumes = term.volumes  # type: ignore[union-attr]
    skeleton = work.motion.skeleton
    with tempfile.TemporaryDirectory() as folder:
        given, made = (os.path.join(folder, f) for f in ("work.npz", "poses.npz"))
        np.savez(
            given, parents=skeleton.parents, offsets=skeleton.offsets, rest_rotations=skeleton.rest_rotations,
            root=work.motion.root, rotations=work.motion.rotations, dt=work.motion.dt,
            capsule_joint=volumes.joints, capsule_start=volumes.start, capsule_end=volumes.end,
            capsule_radius=np.mean(volumes.radii, axis=-1), first=term.first, second=term.second,  # type: ignore[union-attr]
            allowed=work.allowed[:, list(work.clearance.pair_of_row)],
        )  # fmt: skip
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        done = subprocess.run(
            [python, str(script), given, made], capture_output=True, text=True, timeout=timeout_s, check=False,
            env=environment,
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError(f"{name} did not run: {' '.join(done.stderr.strip().splitlines()[-1:])}")
        told = json.loads(done.stdout.strip().splitlines()[-1])
        with np.load(made) as data:
            rotations = np.asarray(data["rotations"], float)
    rotations /= np.linalg.norm(rotations, axis=-1, keepdims=True)
    motion = mf.Motion(skeleton, work.motion.root, rotations, work.motion.dt)
    return judge(f"{name} {told['version']}", work, motion, told["frame_s"], told["fk_frame_s"], told["note"])


def _interpreter(name: str) -> str:
    """The Python that has the peer; a `RuntimeError` that says how to get one."""
    package, module = {"mink": ("mink daqp", "mink"), "momentum": ("pymomentum-cpu", "pymomentum.solver2")}[name]
    variable = f"{name.upper()}_PYTHON"
    python = os.environ.get(variable) or (sys.executable if name == "mink" else shutil.which("python3.12"))
    if python is None:
        raise RuntimeError(f"{name} needs Python 3.12 with {package}; name it in {variable}")
    found = subprocess.run([python, "-c", f"import {module}"], capture_output=True, text=True, check=False)
    if found.returncode:
        why = (found.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise RuntimeError(f"the interpreter for {name} cannot import it ({why}); "
                           f"pip install {package} somewhere and name its python in {variable}")  # fmt: skip
    return python


def table(rows: list[Judged]) -> str:
    """The comparison in markdown."""
    lines = ["| library | ms/frame | FK ms/frame | worst excess [cm] | frames over 1 cm | deviation [rad] | jerk ratio "
             "| pairs over 1 cm | note |", "|---" * 9 + "|"]  # fmt: skip
    for r in rows:
        lines.append(f"| {r.name} | {1e3 * r.frame_s:.4g} | {1e3 * r.fk_frame_s:.3g} | {100 * r.worst_m:.2f} "
                     f"| {r.over_1cm:.1%} | {r.deviation_rad:.4f} | {r.jerk_ratio:.3g} | {r.pairs_left} | {r.note} |")  # fmt: skip
    return "\n".join(lines)


# --- benchmark entries -----------------------------------------------------------------------------------------


def _entry(name: str) -> Iterator[Metric]:
    from benchmarks.workloads import Skip

    work = builtin_work()
    try:
        theirs = run_peer(name, work)
    except (RuntimeError, subprocess.TimeoutExpired) as reason:
        raise Skip(str(reason)) from None
    mine = ours(work)
    print(table([untouched(work), mine, theirs]), flush=True)
    key = f"peer-{name}"
    yield Metric(f"{key}.ours_over_theirs", mine.frame_s / theirs.frame_s, "ratio", "lower", 1.0, 0.0, True)
    yield seconds(f"{key}.ours", mine.frame_s, "ms/frame")
    yield seconds(f"{key}.theirs", theirs.frame_s, "ms/frame")
    yield seconds(f"{key}.fk_theirs", theirs.fk_frame_s, "us/frame")
    # what they leave is theirs to answer for: stored for the record, not gated
    yield Metric(f"{key}.excess_left_ours", mine.worst_m, "m", "lower", 0.05, 2e-4)
    yield Metric(f"{key}.excess_left_theirs", theirs.worst_m, "m")
    yield Metric(f"{key}.deviation_ours", mine.deviation_rad, "rad", "lower", 0.02, 1e-4)
    yield Metric(f"{key}.deviation_theirs", theirs.deviation_rad, "rad")


def mink() -> Iterator[Metric]:
    """Frame after frame by differential inverse kinematics with collision limits (mink, MuJoCo)."""
    yield from _entry("mink")


def momentum() -> Iterator[Metric]:
    """A sequence solve with capsule collision over all joints (Meta's momentum)."""
    yield from _entry("momentum")


def main() -> None:
    """Run the comparison from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peers", nargs="*", default=["mink", "momentum"], metavar="mink|momentum")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--data", type=pathlib.Path, help="folder with bvh/*.bvh and characters/*.glb")
    parser.add_argument("--clip", default="bvh/02_01_walk")
    parser.add_argument("--body", default="heavy_male")
    parser.add_argument("--reference", default="avg_male")
    options = parser.parse_args()
    if options.data:
        bodies = [mf.load_character(options.data / f"characters/{n}.glb") for n in (options.body, options.reference)]
        work = work_of(mf.load_motion(options.data / f"{options.clip}.bvh")[: options.frames], *bodies)
    else:
        work = builtin_work(options.frames)
    rows = [untouched(work), ours(work)]
    for name in options.peers:
        try:
            rows.append(run_peer(name, work))
        except RuntimeError as reason:
            print(f"{name} skipped: {reason}", flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()

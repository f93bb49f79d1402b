"""The entries: what is measured, each a generator of metrics. `python -m benchmarks` runs them."""

import functools
import itertools
import math
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import motionfit as mf
from benchmarks.metrics import (
    Metric,
    compilations,
    compile_reference,
    compile_s,
    fixed_work,
    has_banded,
    interleaved,
    numpy_kinematics,
    peak_memory_gib,
    reset_peak_memory,
    seconds,
    time_ratio,
)
from motionfit import rotation, samples
from motionfit.metrics import derivative_ratio, joint_angle_deviation, skin_depths
from motionfit.shape.growth import grow

FRAMES = 300


class Skip(Exception):
    """An entry cannot run here, and why: printed, never gated."""


@dataclass(frozen=True)
class Entry:
    """A named piece of work. Heavy ones run only when named, or with --all."""

    name: str
    run: Callable[[], Iterator[Metric]]
    about: str
    heavy: bool = False


def clip_of(frames: int, rate: float = 60.0) -> mf.Motion:
    """The built-in walk at `rate` [1/s], as many cycles as the frames take."""
    cycle = samples.walk(rate, cycles=1).frame_count - 1
    return samples.walk(rate, cycles=math.ceil(frames / cycle))[:frames]


def body(name: str) -> mf.Character:
    """A built-in body, fresh: what is fitted to a character is kept with it, and must not be there already."""
    return mf.load_character(f"builtin:{name}")


def _single(tree):
    """Host arrays in float32 on the device, so that no call pays for the transfer."""

    def moved(x):
        if not isinstance(x, np.ndarray):
            return x
        return jnp.asarray(x, jnp.float32 if np.issubdtype(x.dtype, np.floating) else None)

    return jax.tree.map(moved, tree)


def _skip_dense(frames: int) -> None:
    if not has_banded():
        raise Skip(f"{frames} frames need the banded solver, motionfit.banded; the dense one takes hours")


# --- kinematics and skin ---------------------------------------------------------------------------------------


def naive_kinematics(skeleton: mf.Skeleton, motion: mf.Motion):
    """World positions joint after joint in JAX: what one writes first."""
    turns, places = [], []
    for joint, parent in enumerate(skeleton.parents):
        local = motion.rotations[:, joint]
        if parent < 0:
            turns.append(local)
            places.append(motion.root)
            continue
        places.append(places[parent] + rotation.rotate(turns[parent], jnp.asarray(skeleton.offsets)[joint][None]))
        turns.append(rotation.multiply(turns[parent], local))
    return jnp.stack(places, axis=1)


def _positions(motion: mf.Motion, kinematics: Callable):
    """World positions as a function of the rotations alone."""
    return lambda rotations: kinematics(
        motion.skeleton, mf.Motion(motion.skeleton, motion.root, rotations, motion.dt)
    )  # fmt: skip


def _ours(skeleton, motion):
    return mf.forward_kinematics(skeleton, motion).positions_world


def fk(frames: int = FRAMES) -> Iterator[Metric]:
    """Forward kinematics, level by level against joint by joint, and against NumPy for the numbers."""
    host = clip_of(frames)
    walk = _single(host)
    ours, naive = (_positions(walk, k) for k in (_ours, naive_kinematics))
    oracle, _ = numpy_kinematics(host.skeleton.parents, host.skeleton.offsets, host.root, host.rotations)
    yield Metric("fk.error", float(np.abs(np.asarray(ours(walk.rotations)) - oracle).max()), "m", "lower", 0.1, 5e-6)
    yield from _against(walk, "fk", ours, naive)


def fk_gradient(frames: int = FRAMES) -> Iterator[Metric]:
    """The gradient of a sum of squares of all positions in all rotations."""
    walk = _single(clip_of(frames))

    def gradient(kinematics):
        positions = _positions(walk, kinematics)
        return jax.grad(lambda rotations: jnp.sum(positions(rotations) ** 2))

    ours, naive = gradient(_ours), gradient(naive_kinematics)
    a, b = (np.asarray(jax.jit(g)(walk.rotations), float) for g in (ours, naive))
    yield Metric("fk-gradient.error", float(np.abs(a - b).max() / np.abs(b).max()), "share", "lower", 0.1, 1e-5)
    yield from _against(walk, "fk-gradient", ours, naive)


def _against(walk: mf.Motion, name: str, ours: Callable, naive: Callable) -> Iterator[Metric]:
    rotations = walk.rotations
    compiling = [compile_s(fn, rotations) for fn in (ours, naive)]
    fast, slow = jax.jit(ours), jax.jit(naive)
    pace = interleaved(lambda: fast(rotations), lambda: slow(rotations))
    yield seconds(f"{name}.run", pace.run_s, "ms")
    yield seconds(f"{name}.run_naive", pace.reference_s, "ms")
    yield time_ratio(f"{name}.run_over_naive", pace.ratio)
    yield seconds(f"{name}.compile", compiling[0])
    yield time_ratio(f"{name}.compile_over_naive", compiling[0] / compiling[1], 1.5)


def skin(frames: int = FRAMES) -> Iterator[Metric]:
    """Linear blend skinning with normals, per frame, against NumPy on a few frames."""
    character, host = body("average"), clip_of(frames)
    walk, mesh = _single(host), _single(character.skin)
    few = slice(0, 8)
    positions, turned = numpy_kinematics(
        host.skeleton.parents, host.skeleton.offsets, host.root[few], host.rotations[few]
    )
    rest = host.skeleton
    bind, bind_turn = numpy_kinematics(rest.parents, rest.offsets, rest.offsets[:1], rest.rest_rotations[None])

    def in_numpy():
        relative = turned @ np.swapaxes(bind_turn, -1, -2)
        move = positions - np.einsum("tjab,jb->tja", relative, bind[0])
        joints, weights = np.asarray(character.skin.joints), np.asarray(character.skin.weights)
        points = np.asarray(character.skin.vertices_bind)
        total = np.zeros((len(positions), len(points), 3))
        for k in range(joints.shape[1]):
            moved = np.einsum("tpab,pb->tpa", relative[:, joints[:, k]], points) + move[:, joints[:, k]]
            total += weights[:, k, None] * moved
        return total

    ours = jax.jit(lambda mesh, motion: mf.skin(mesh, mf.forward_kinematics(motion.skeleton, motion)))
    error = np.abs(np.asarray(ours(mesh, walk)[0][few]) - in_numpy()).max()
    yield Metric("skin.error", float(error), "m", "lower", 0.1, 5e-6)
    pace = interleaved(lambda: ours(mesh, walk), in_numpy, rounds=9)
    yield seconds("skin.run", pace.run_s / frames, "us/frame")
    yield time_ratio("skin.run_over_numpy", pace.ratio * len(positions) / frames, 1.0)


def _with_joints(skeleton: mf.Skeleton, motion: mf.Motion, joints: int) -> tuple[mf.Skeleton, mf.Motion]:
    """The same body with helper joints: copies of the whole tree hung on its joints, one after the other."""
    names, parents, offsets = list(skeleton.names), list(skeleton.parents), [*np.asarray(skeleton.offsets)]
    rotations, rest = [motion.rotations], [*np.asarray(skeleton.rest_rotations)]
    copy = 0
    while len(names) < joints:
        copy += 1
        start = len(names)
        # hung on a joint of its own, so that copies make the tree wide more than deep
        host = 1 + (copy - 1) % (len(skeleton.names) - 1)
        # a name that no naming convention knows, so that roles stay where they are
        names += [f"helper_{copy}_{k}" for k in range(len(skeleton.names))]
        parents += [host if p < 0 else p + start for p in skeleton.parents]
        offsets += [np.zeros(3), *np.asarray(skeleton.offsets)[1:]]
        rest += [*np.asarray(skeleton.rest_rotations)]
        rotations.append(motion.rotations)
    keep = slice(0, joints)
    grown = mf.Skeleton(
        names[keep], parents[keep], np.array(offsets[keep]), np.array(rest[keep]),
        roles={role: skeleton.names[joint] for role, joint in skeleton.roles},
        end_parents=skeleton.end_parents, end_offsets=skeleton.end_offsets,
    )  # fmt: skip
    return grown, mf.Motion(grown, motion.root, np.concatenate(rotations, axis=1)[:, keep], motion.dt)


def joints(counts: tuple[int, ...] = (31, 124, 496)) -> Iterator[Metric]:
    """Kinematics and gradient as the skeleton grows: time and compile time per joint, over that of 31 joints."""
    base = clip_of(FRAMES)
    works, compiling = {}, {}
    for count in counts:
        _, motion = _with_joints(base.skeleton, base, count)
        motion = _single(motion)
        positions = _positions(motion, _ours)
        gradient = jax.grad(lambda rotations, positions=positions: jnp.sum(positions(rotations) ** 2))
        compiling[count] = compile_s(gradient, motion.rotations)
        works[count] = functools.partial(jax.jit(gradient), motion.rotations)
    first = counts[0]
    for count in counts[1:]:
        pace = interleaved(works[count], works[first])
        yield seconds(f"joints.run_{count}", pace.run_s, "ms")
        # a few joints stay in a core's cache, many do not, which costs by machine and neighbours up to twice as much;
        # the square of their number would cost sixteen times as much
        yield time_ratio(f"joints.run_per_joint_{count}_over_{first}", pace.ratio * first / count, 1.0)
        yield time_ratio(f"joints.compile_{count}_over_{first}", compiling[count] / compiling[first], 1.5)


# --- adaptation ------------------------------------------------------------------------------------------------


class _Calls(NamedTuple):
    fit: mf.Fit
    metrics: tuple[Metric, ...]


def _compile_and_run(key: str, frames: int, run: Callable[[mf.Motion, mf.Character, mf.Character], mf.Fit]) -> _Calls:
    """Time an adaptation with what happens once taken apart: compiling, what is fitted to a body, and the run."""
    walk, heavy, average = clip_of(frames), body("heavy"), body("average")
    start = time.perf_counter()
    fit = run(walk, heavy, average)
    first_s = time.perf_counter() - start
    others = body("heavy"), body("average")
    start = time.perf_counter()
    run(walk, *others)
    fresh_s = time.perf_counter() - start
    pace = interleaved(lambda: run(walk, heavy, average), fixed_work(), rounds=5)
    compiling_s = first_s - fresh_s
    return _Calls(fit, (
        seconds(f"{key}.run", pace.run_s / frames, "ms/frame"),
        time_ratio(f"{key}.run_over_fixed", pace.ratio, 1.0),
        seconds(f"{key}.new_body", fresh_s - pace.run_s),
        seconds(f"{key}.compile", compiling_s),
        time_ratio(f"{key}.compile_over_fixed", compiling_s / compile_reference(), 1.5),
    ))  # fmt: skip


def block(name: str, frames: int = FRAMES) -> Iterator[Metric]:
    """One block by itself: its cost, what is left on the volumes, its time and compile time."""
    key = f"block-{name}"
    calls = _compile_and_run(
        key, frames, lambda clip, body, own: mf.adapt(clip, body, reference=own, blocks=(name,))
    )  # fmt: skip
    fit = calls.fit
    last = {b.name: b for b in fit.history}  # a recipe may have several blocks (one per arm), and look at them twice
    yield Metric(f"{key}.cost", sum(b.cost_after for b in last.values()), "1", "lower", 0.01)
    yield Metric(f"{key}.excess_left", _left(fit), "m", "lower", 0.05, 2e-4)
    yield Metric(f"{key}.steps", sum(b.accepted_steps for b in fit.history), "steps", "lower", 0.25, 2)
    yield from calls.metrics


def _left(fit: mf.Fit) -> float:
    """The deepest excess [m] on the volumes that an adaptation left."""
    return float(max(np.asarray(fit.details["excess_after_m"]).max(initial=0.0), 0.0))


def adaptation(frames: int = FRAMES) -> Iterator[Metric]:
    """The whole procedure on the heavy body: what is left on volumes and skin, what it cost the motion, the time."""
    walk, heavy, average = clip_of(frames), body("heavy"), body("average")
    run = functools.partial(mf.adapt, reference=average)
    calls = _compile_and_run("adapt", frames, lambda clip, body, own: mf.adapt(clip, body, reference=own))
    fit = calls.fit
    step = max(1, frames // 60)
    own = skin_depths(average, mf.onto(walk, average.skeleton), step=step).depth
    skin_left = (skin_depths(heavy, fit.motion, step=step).depth - own).max(initial=0.0)
    yield Metric("adapt.excess_left", _left(fit), "m", "lower", 0.05, 2e-4)
    yield Metric("adapt.skin_excess_left", float(skin_left), "m", "lower", 0.05, 2e-4)
    yield Metric("adapt.deviation", joint_angle_deviation(fit.motion, fit.base)[0], "rad", "lower", 0.02, 1e-4)
    yield Metric("adapt.jerk_ratio", derivative_ratio(fit.motion, fit.base, 3) or math.nan, "ratio", "lower", 0.02)
    yield from calls.metrics
    girth = grow(heavy, {"arms": 1.1})
    yield Metric("adapt.compilations_other_girth", compilations(lambda: run(walk, girth)), "programs", "lower", 0.0)
    # a few frames less: still in the same length bucket
    yield Metric("adapt.compilations_other_length", compilations(lambda: run(walk[:-7], heavy)), "programs", "lower", 0)


def ten_minutes(rate: float = 120.0) -> Iterator[Metric]:
    """Whole adaptation of ten minutes at 120 frames per second in one call: memory, and what is left."""
    clip, heavy, average = clip_of(round(600 * rate), rate), body("heavy"), body("average")
    reset_peak_memory()
    start = time.perf_counter()
    fit = mf.adapt(clip, heavy, reference=average)
    yield seconds("ten-minutes.first", time.perf_counter() - start)
    yield Metric("ten-minutes.memory", peak_memory_gib(), "GiB", "lower", 0.25, 0.25)
    yield Metric("ten-minutes.excess_left", _left(fit), "m", "lower", 0.05, 2e-4)


DRAFT: dict[str, Any] = {"objective": "capsule", "blocks": ("arms", "legs")}  # nothing is looked at on the skin


def frames(count: int, base: int = 600, draft: bool = False) -> Iterator[Metric]:
    """Whole adaptation of a long clip, warm: time per frame over that of a 600-frame clip, and memory."""
    key, options = f"frames-{count}{'-capsule' if draft else ''}", DRAFT if draft else {}
    if count >= 3000:
        _skip_dense(count)
    heavy, average = body("heavy"), body("average")
    long, short = (functools.partial(mf.adapt, clip_of(n), heavy, reference=average, **options) for n in (count, base))
    reset_peak_memory()
    start = time.perf_counter()
    fit = long()
    yield seconds(f"{key}.first", time.perf_counter() - start)
    yield Metric(f"{key}.memory", peak_memory_gib(), "GiB", "lower", 0.25, 0.25)
    yield Metric(f"{key}.excess_left", _left(fit), "m", "lower", 0.05, 2e-4)
    pace = interleaved(long, short, rounds=5, budget_s=30.0)
    yield seconds(f"{key}.run", pace.run_s / count, "ms/frame")
    yield time_ratio(f"{key}.per_frame_over_{base}", pace.ratio * base / count)


def joints_adapt(counts: tuple[int, ...] = (31, 124), frame_count: int = FRAMES) -> Iterator[Metric]:
    """The whole adaptation with helper joints on the body: the same result, in how much more time."""
    heavy, average, walk = body("heavy"), body("average"), clip_of(frame_count)
    works, fits = {}, {}
    for count in counts:
        characters = [
            mf.Character(_with_joints(c.skeleton, mf.onto(walk, c.skeleton), count)[0], c.skin, c.name)
            for c in (heavy, average)
        ]
        _, motion = _with_joints(heavy.skeleton, mf.onto(walk, heavy.skeleton), count)
        works[count] = functools.partial(mf.adapt, motion, characters[0], reference=characters[1])
        fits[count] = works[count]()
    few, many = counts[0], counts[-1]
    costs = [sum({b.name: b.cost_after for b in fits[k].history}.values()) for k in (many, few)]
    yield Metric("joints-adapt.cost_over_few", costs[0] / costs[1], "ratio", "equal", 0.01)
    pace = interleaved(works[many], works[few], rounds=5)
    yield seconds("joints-adapt.run", pace.run_s / frame_count, "ms/frame")
    yield time_ratio(f"joints-adapt.run_{many}_over_{few}", pace.ratio)


def girths(count: int) -> list[dict[str, float]]:
    """Girths of the run-time system of thesis 5: three sizes of each arm, each leg and the trunk, 3^5 = 243."""
    parts: tuple[str, ...] = ("trunk", "left_leg", "right_leg", "left_arm", "right_arm")
    grid: list[dict[str, float]] = [
        dict(zip(parts, s, strict=True)) for s in itertools.product((1.0, 1.3, 1.6), repeat=len(parts))
    ]
    # spread over the grid, the middle one alone where only one is wanted
    return [grid[k] for k in np.linspace(0, len(grid) - 1, count + 2).astype(int)[1:-1]] if count < len(grid) else grid


def shapes(count: int, frame_count: int = FRAMES, draft: bool = False) -> Iterator[Metric]:
    """One clip on many girths in one batch: time per shape over that of `adapt` alone, what is left, memory."""
    key, options = f"shapes-{count}{'-capsule' if draft else ''}", DRAFT if draft else {"blocks": DRAFT["blocks"]}
    if not hasattr(mf, "adapt_many"):
        raise Skip("this version has no motionfit.adapt_many")
    if count >= 100:
        _skip_dense(frame_count)
    walk, average = clip_of(frame_count), body("average")
    bodies = [grow(average, girth) for girth in girths(count)]

    peaks = [0.0]

    def many() -> list[float]:
        fits = mf.adapt_many(walk, bodies, reference=average, **options,
                             progress=lambda _: peaks.append(peak_memory_gib(children=True)))  # fmt: skip
        return [_left(fit) for fit in fits]

    alone = functools.partial(mf.adapt, walk, bodies[len(bodies) // 2], reference=average, **options)
    reset_peak_memory()
    start = time.perf_counter()
    left = many()
    first_s = time.perf_counter() - start
    yield seconds(f"{key}.first", first_s)
    yield Metric(f"{key}.memory", max(peaks), "GiB", "lower", 0.25, 0.25)
    yield Metric(f"{key}.excess_left", max(left), "m", "lower", 0.05, 2e-4)
    if count >= 100:  # minutes: the first run is the measurement, its compile time included
        jax.block_until_ready(alone().motion.rotations)
        start = time.perf_counter()
        alone()
        alone_s = time.perf_counter() - start
        yield seconds(f"{key}.run", first_s / count, "s/shape")
        yield time_ratio(f"{key}.per_shape_over_alone", first_s / count / alone_s)
        return
    pace = interleaved(many, alone, rounds=2)  # minutes each
    yield seconds(f"{key}.run", pace.run_s / count, "s/shape")
    yield time_ratio(f"{key}.per_shape_over_alone", pace.ratio / count)


# --- whole processes -------------------------------------------------------------------------------------------


def _process_s(*code: str, **environment: str) -> float:
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *code], env={**os.environ, **environment}, capture_output=True, text=True, check=False,
        cwd=pathlib.Path(__file__).parents[1],
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"a process of its own failed: {done.stderr.strip().splitlines()[-1:]}")
    return time.perf_counter() - start


def importing(rounds: int = 5) -> Iterator[Metric]:
    """`import motionfit`, alone and with all that `adapt` needs, against `import jax, optimistix`, each in a process."""
    codes = ("import motionfit", "import motionfit; motionfit.adapt", "import jax, optimistix")
    times = [[_process_s("-c", code) for code in codes] for _ in range(rounds + 1)][
        1:
    ]  # the first fills the page cache
    alone, adapt, theirs = np.median(times, axis=0)
    yield seconds("import.motionfit", alone)
    yield seconds("import.motionfit_adapt", adapt)
    yield seconds("import.jax_optimistix", theirs)
    yield time_ratio("import.over_jax_optimistix", float(np.median([a / c for a, _, c in times])), 0.25)
    yield time_ratio("import.adapt_over_jax_optimistix", float(np.median([b / c for _, b, c in times])), 0.25)


def cold(frame_count: int = FRAMES) -> Iterator[Metric]:
    """The command line from process start to written output: with an empty compilation cache, then a warm one."""
    with tempfile.TemporaryDirectory() as folder:
        place = pathlib.Path(folder)
        clip = clip_of(frame_count)
        mf.save(place / "clip.npz", clip)
        for name in ("heavy", "average"):
            mf.save(place / f"{name}.glb", mf.onto(clip[:2], body(name).skeleton), body(name))
        code = "import sys; from motionfit.cli import main; sys.argv = ['motionfit', *sys.argv[1:]]; main()"
        arguments = ("adapt", str(place / "clip.npz"), str(place / "heavy.glb"), "-o", str(place / "out.npz"),
                     "--reference", str(place / "average.glb"))  # fmt: skip
        times = [_process_s("-c", code, *arguments, MOTIONFIT_CACHE=str(place / "cache")) for _ in range(3)]
        jax_s = [_process_s("-c", "import jax, optimistix") for _ in range(3)]
    yield seconds("cold.empty_cache", times[0])
    yield seconds("cold.warm_cache", min(times[1:]))
    yield time_ratio("cold.empty_cache_over_import", times[0] / float(np.median(jax_s)), 1.0)
    yield time_ratio("cold.warm_cache_over_import", min(times[1:]) / float(np.median(jax_s)), 1.0)


def entries() -> tuple[Entry, ...]:
    """All entries in the order in which they run."""
    from benchmarks import finite_differences, peers

    def made(name: str, run: Callable, *arguments, heavy: bool = False) -> Entry:
        about = (run.__doc__ or "").strip().splitlines()[0]
        return Entry(name, functools.partial(run, *arguments), about, heavy)

    return (
        made("import", importing),
        made("fk", fk),
        made("fk-gradient", fk_gradient),
        made("skin", skin),
        made("joints", joints),
        *(made(f"block-{name}", block, name) for name in ("arms", "legs")),
        made("adapt", adaptation),
        made("frames-300", frames, 300),
        made("frames-3000", frames, 3000, heavy=True),
        made("frames-30000", frames, 30000, heavy=True),
        *(made(f"frames-{n}-capsule", frames, n, 600, True, heavy=True) for n in (300, 3000, 30000)),
        made("ten-minutes", ten_minutes, heavy=True),
        made("joints-adapt", joints_adapt, heavy=True),
        made("shapes-1", shapes, 1),
        made("shapes-8", shapes, 8),
        made("shapes-243", shapes, 243, 800, heavy=True),
        made("shapes-243-capsule", shapes, 243, 800, True, heavy=True),
        made("cold", cold),
        made("solvers", finite_differences.solvers),
        made("finite-differences", finite_differences.entry, heavy=True),
        made("peer-mink", peers.mink, heavy=True),
        made("peer-momentum", peers.momentum, heavy=True),
    )

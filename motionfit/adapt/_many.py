"""One clip on many bodies."""

import atexit
import contextlib
import functools
import os
import shutil
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from itertools import islice
from operator import length_hint

import jax

from motionfit._character import Character
from motionfit._fit import Fit
from motionfit._motion import Motion
from motionfit._traces import SETTINGS, keep_programs, programs_folder
from motionfit.adapt._clearance import OBJECTIVES
from motionfit.adapt._procedure import adapt

AHEAD = 2  # bodies per worker that wait or are in work: results come in order, and no worker waits for another's
One = Callable[[Character, Fit | None], Fit]
_one: One  # of a worker


def adapt_many(
    clip: Motion,
    bodies: Iterable[Character],
    *,
    reference: Character | None = None,
    blocks: Sequence[str] | None = None,
    objective: str = OBJECTIVES[0],
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Fit]:
    """Adapt one clip to many bodies of one topology: the fits, one by one, in the order of `bodies`.

        girths = ({"arms": a, "trunk": t} for a in (0.8, 1.0, 1.5) for t in (0.8, 1.0, 1.5))
        for fit in mf.adapt_many(clip, (mf.shape.grow(body, g) for g in girths), reference=body):
            fit.correction.save(...)

    `workers` bodies are adapted at once, each in a process of its own that takes most of a gigabyte (None: one per
    processor; 1: here, one after the other). Both ends are lazy, so memory holds these and a few that wait. All share
    the first one's compiled programs, and each starts from the last result at hand: give bodies that are alike next to
    each other. `progress(done)` is called after each.
    """
    workers = min(workers or os.cpu_count() or 1, length_hint(bodies) or sys.maxsize)
    one = functools.partial(_adapted, clip, reference, None if blocks is None else tuple(blocks), objective)
    if workers == 1 or jax.default_backend() != "cpu":  # one accelerator is one worker
        return _in_turn(one, bodies, progress)
    return _at_once(one, bodies, workers, progress)


def _adapted(
    clip: Motion,
    reference: Character | None,
    blocks: tuple[str, ...] | None,
    objective: str,
    body: Character,
    start: Fit | None,
) -> Fit:
    fit = adapt(clip, body, reference=reference, blocks=blocks, objective=objective, start=start)
    if body is not reference:
        body.memo.clear()  # tables of megabytes, of no use to the next body
    return fit


def _in_turn(one: One, bodies: Iterable[Character], progress: Callable[[int], None] | None) -> Iterator[Fit]:
    last = None
    for done, body in enumerate(bodies, 1):
        last = one(body, last)
        if progress is not None:
            progress(done)
        yield last


def _at_once(
    one: One, bodies: Iterable[Character], workers: int, progress: Callable[[int], None] | None
) -> Iterator[Fit]:
    """In processes, since threads would wait for each other: libigl holds Python's lock, and half of an adaptation are
    looks at the skin."""
    from loky import ProcessPoolExecutor  # unlike the standard library's, it asks no script for a guard of __main__

    waiting, last, done = iter(bodies), None, 0
    running: deque[Future[Fit]] = deque()
    with contextlib.ExitStack() as stack:
        folder = str(programs_folder() or _shared_folder())  # what the first one compiles, the others find here
        settings = {name: getattr(jax.config, name) for name in SETTINGS}
        pool = ProcessPoolExecutor(workers, initializer=_begin, initargs=(one, folder, settings))
        stack.callback(pool.shutdown, kill_workers=True)  # also where nobody wants the rest
        while True:
            # the first alone: it compiles for all
            for body in islice(waiting, (AHEAD * workers if done else 1) - len(running)):
                running.append(pool.submit(_run, body, last))
            if not running:
                return
            last, done = running.popleft().result(), done + 1
            if progress is not None:
                progress(done)
            yield last


@functools.cache
def _shared_folder() -> str:
    """Where nothing is kept for the next process, workers share their programs as long as this one lives."""
    folder = tempfile.mkdtemp(prefix="motionfit-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _begin(one: One, folder: str, settings: dict) -> None:
    global _one
    for name, value in settings.items():
        jax.config.update(name, value)
    keep_programs(folder)
    _one = one


def _run(body: Character, start: Fit | None) -> Fit:
    return _one(body, start)

"""One clip on many bodies."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice

from motionfit._character import Character
from motionfit._fit import Fit
from motionfit._motion import Motion
from motionfit.adapt._clearance import OBJECTIVES
from motionfit.adapt._procedure import DEFAULT, adapt


def adapt_many(
    clip: Motion,
    bodies: Iterable[Character],
    *,
    reference: Character | None = None,
    blocks: Sequence[str] = DEFAULT,
    objective: str = OBJECTIVES[0],
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Fit]:
    """Adapt one clip to many bodies of one topology: the fits, one by one, in the order of `bodies`.

        girths = ({"arms": a, "trunk": t} for a in (0.8, 1.0, 1.5) for t in (0.8, 1.0, 1.5))
        for fit in mf.adapt_many(clip, (mf.shape.grow(body, g) for g in girths), reference=body):
            fit.correction.save(...)

    Both ends are lazy, so memory holds only the bodies in work, `workers` of them (None: one per processor). All
    share the first one's compiled programs, and each starts from the last result at hand: give bodies that are alike
    next to each other. `progress(done)` is called after each.
    """
    workers = workers or os.cpu_count() or 1

    def one(body: Character, start: Fit | None) -> Fit:
        fit = adapt(clip, body, reference=reference, blocks=blocks, objective=objective, start=start)
        if body is not reference:
            body.memo.clear()  # tables of megabytes, of no use to the next body
        return fit

    waiting, last, done = iter(bodies), None, 0
    running: deque[Future[Fit]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        while True:
            # the first alone: it compiles for all
            for body in islice(waiting, (workers if done else 1) - len(running)):
                running.append(pool.submit(one, body, last))
            if not running:
                return
            last, done = running.popleft().result(), done + 1
            if progress is not None:
                progress(done)
            yield last

"""Inverse kinematics with any number of strict priorities: Baerlocher & Boulic 2004.

A task of lower priority acts in the null space of all tasks above it: it cannot change what they achieve. Every
function works on a batch of independent problems at once (one per frame).
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

Task = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

CALM = 10  # steps before the longest step shrinks, as one over their number
POLISH = 20  # last steps of the tasks above the lowest one
RANK = 1e-6  # singular values below this share of the greatest are directions that a task cannot move


def prioritized_step(
    jacobians: Sequence[Float[np.ndarray, "batch _ joints"]],
    errors: Sequence[Float[np.ndarray, "batch _"]],
    *,
    damping: float = 0.0,
    free: Bool[np.ndarray, "batch joints"] | None = None,
) -> Float[np.ndarray, "batch joints"]:
    """The change of the joint values that serves the tasks in order of priority, the first one first.

    With P_0 = 1, for each task: dq += (J_k P)^+ (e_k - J_k dq), then P -= (J_k P)^+ (J_k P). `damping` [in units of
    J] turns singular values s into s / (s^2 + damping^2) in the steps; the projectors stay undamped, so that the
    priorities remain strict. Columns that are not `free` are left out.
    """
    batch, joints = jacobians[0].shape[0], jacobians[0].shape[2]
    change = np.zeros((batch, joints))
    allowed = np.ones((batch, joints)) if free is None else free.astype(float)
    projector = allowed[:, :, None] * np.eye(joints)
    for jacobian, error in zip(jacobians, errors, strict=True):
        left = error - np.einsum("bmj,bj->bm", jacobian, change)
        u, s, vt = np.linalg.svd(jacobian @ projector, full_matrices=False)
        # a task without rank left in the null space moves nothing; its scale is that of the task itself
        scale = np.maximum(np.linalg.norm(jacobian, axis=(1, 2)), 1e-300)[:, None]
        live = s > RANK * scale
        inverse = np.where(live, s / np.where(live, s * s + damping**2, 1.0), 0.0)
        change = change + np.einsum("bkj,bk,bmk,bm->bj", vt, inverse, u, left)
        rows = np.where(live[..., None], vt, 0.0)
        projector = projector - np.swapaxes(rows, 1, 2) @ rows
    return change


def limited_step(
    jacobians: Sequence[Float[np.ndarray, "batch _ joints"]],
    errors: Sequence[Float[np.ndarray, "batch _"]],
    values: Float[np.ndarray, "batch joints"],
    lower: Float[np.ndarray, "... joints"],
    upper: Float[np.ndarray, "... joints"],
    *,
    damping: float = 0.0,
) -> Float[np.ndarray, "batch joints"]:
    """A prioritized step within joint limits: a joint that would pass its limit stops there, and the others take
    over what it cannot do (the clamping loop of Baerlocher & Boulic 2004, 4.3)."""
    free = np.ones(values.shape, bool)
    fixed = np.zeros(values.shape)
    change = fixed
    for _ in range(values.shape[1] + 1):
        left = [e - np.einsum("bmj,bj->bm", j, fixed) for j, e in zip(jacobians, errors, strict=True)]
        change = np.where(free, prioritized_step(jacobians, left, damping=damping, free=free), fixed)
        after = values + change
        beyond = free & ((after < lower - 1e-12) | (after > upper + 1e-12))
        if not beyond.any():
            break
        fixed = np.where(beyond, np.clip(after, lower, upper) - values, fixed)
        free &= ~beyond
    return change


def prioritized(
    tasks: Sequence[Task],
    values: Float[np.ndarray, "batch joints"],
    *,
    lower: Float[np.ndarray, "... joints"] | None = None,
    upper: Float[np.ndarray, "... joints"] | None = None,
    damping: float = 0.1,
    tolerance: float = 1e-9,
    max_steps: int = 30,
    max_change: float = 0.3,
) -> Float[np.ndarray, "batch joints"]:
    """Joint values that serve the tasks in order of priority, by repeated steps from `values` on.

    A task is a function of the values (batch, joints) that returns its error (batch, m), what is missing, and the
    Jacobian (batch, m, joints) of what it moves. `damping` is taken times the largest error and at most as it is:
    far away the steps are cautious, near the goal they converge like Newton's. No step changes a joint by more than
    `max_change`, which shrinks after the first `CALM` steps: tasks that cannot be met together would otherwise pull
    the values to and fro. A last word is given to the tasks from below upwards, so that the first is met best. Ends
    when no step is over `tolerance`, or after `max_steps`.
    """
    lower = np.broadcast_to(-np.inf if lower is None else lower, values.shape)
    upper = np.broadcast_to(np.inf if upper is None else upper, values.shape)
    values = np.clip(values, lower, upper)
    levels = range(len(tasks), 0, -1)
    active = np.ones(len(values), bool)
    for level in levels:
        for step in range(max_steps if level == len(tasks) else POLISH):
            found = [task(values) for task in tasks[:level]]
            if level < len(tasks):
                # the polish is for what the lower tasks have left undone above them
                active = np.max([np.abs(e).max(1) for e, _ in found], axis=0) > tolerance
            if not active.any():
                break
            errors, jacobians = [e[active] for e, _ in found], [j[active] for _, j in found]
            worst = max(float(np.abs(e).max()) for e in errors)
            change = limited_step(jacobians, errors, values[active], lower[active], upper[active],
                                  damping=damping * min(worst, 1.0))  # fmt: skip
            longest = np.abs(change).max(1, initial=0.0)
            bound = max_change * min(1.0, CALM / (step + 1))
            change *= np.minimum(1.0, bound / np.maximum(longest, 1e-300))[:, None]
            values = values.copy()
            values[active] = np.clip(values[active] + change, lower[active], upper[active])
            # what no longer moves has arrived, or is as near as its limits and its reach allow
            active[active] = longest > tolerance
    return values

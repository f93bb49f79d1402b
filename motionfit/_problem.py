"""An adaptation problem is data: a character, a base motion, controls, named terms and weights."""

import abc
import dataclasses
from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PyTree

from motionfit._character import Character
from motionfit._control import Control, Correction, turned
from motionfit._motion import Kinematics, Motion, forward_kinematics
from motionfit._skeleton import Skeleton
from motionfit._types import AnyArray, InputError


def _array(x):
    """Numbers become arrays: as Python floats they would be static, and each new value would recompile."""
    return jnp.asarray(x, dtype=float) if isinstance(x, float | int) else x


class Term(eqx.Module):
    """A wish about the motion, as residuals over Kinematics.

    `residual` is dimensionless: divided by a `sigma` that carries the unit ("5 mm counts as 1"). Its leading axis
    are the frames. `reach` says how far a row looks in time: row t depends on the kinematics of the frames
    t - reach .. t + reach alone (0: its own frame; velocities and accelerations by central differences: 1). The fit
    then costs a handful of products per control and time linear in the clip's length. None: it may look anywhere,
    and the block that it stands in is solved densely.
    """

    @property
    def reach(self) -> int | None:
        return 0

    @abc.abstractmethod
    def residual(self, kin: Kinematics) -> Float[Array, "frames ..."]:
        """Dimensionless residuals, frames first."""


class Custom(Term):
    """A term from a plain function: `fn(kin, args) -> residual (frames, ...)`.

    Data goes in `args` (numbers become arrays there), so that a new value does not recompile. Since the function may
    look at any frame, its `reach` is None unless it is given; a wrong one is found out when the term is fitted.
    """

    fn: Callable = eqx.field(static=True)
    args: PyTree = eqx.field(converter=lambda tree: jax.tree.map(_array, tree), default=None)
    frames_around: int | None = eqx.field(static=True, default=None)

    def __init__(self, fn: Callable, args: PyTree = None, *, reach: int | None = None):
        if reach is not None and reach < 0:
            raise InputError(f"reach counts frames on each side of a row and cannot be {reach}; give 0, 1, ... or None")
        self.fn, self.args, self.frames_around = fn, args, reach

    @property
    def reach(self) -> int | None:
        return self.frames_around

    def residual(self, kin: Kinematics) -> Float[Array, "frames ..."]:
        return self.fn(kin, self.args)


class Energy(eqx.Module):
    """A scalar from a plain function, `fn(kin, args) -> energy`; for blocks with a minimiser (BFGS, ...) only."""

    fn: Callable = eqx.field(static=True)
    args: PyTree = eqx.field(converter=lambda tree: jax.tree.map(_array, tree), default=None)

    def energy(self, kin: Kinematics) -> Float[Array, ""]:
        return self.fn(kin, self.args)


class During(Term):
    """Another term, in some frames only, or more in some: its rows are multiplied by the mask (one number per frame)."""

    term: Term
    mask: Float[AnyArray, " frames"]

    @property
    def reach(self) -> int | None:
        return self.term.reach

    def residual(self, kin: Kinematics) -> Float[Array, "frames ..."]:
        rows = self.term.residual(kin)
        return rows * jnp.asarray(self.mask).reshape(-1, *(1,) * (rows.ndim - 1))


def pseudo_huber(rows: Float[Array, "*rows"], c: Float[Array, ""]) -> Float[Array, "*rows"]:
    """Rows r whose square is quadratic where they are small and linear beyond `c`:
    1/2 rho(r)^2 = c^2 (sqrt(1 + (r/c)^2) - 1)."""
    scaled = rows / c
    # 2 (sqrt(1+s^2) - 1) = 2 s^2 / (sqrt(1+s^2) + 1): no cancellation for small s, and its root is
    # s * sqrt(2 / (...)), which keeps the sign and is smooth at zero
    return c * scaled * jnp.sqrt(2.0 / (jnp.sqrt(1.0 + scaled * scaled) + 1.0))


class Robust(Term):
    """Another term under the pseudo-Huber loss: quadratic for small rows, linear beyond `c` (dimensionless)."""

    term: Term
    c: Float[AnyArray, ""] = eqx.field(converter=_array, default=2.0)

    @property
    def reach(self) -> int | None:
        return self.term.reach

    def residual(self, kin: Kinematics) -> Float[Array, "frames ..."]:
        return pseudo_huber(self.term.residual(kin), jnp.asarray(self.c))


class Problem(eqx.Module):
    """character + base motion + controls + named terms + weights. Immutable; vmap it, differentiate it, edit it
    with `eqx.tree_at`.

    `weights` are dimensionless and linear (1 where not given).
    """

    character: Character
    motion: Motion
    terms: dict[str, Term | Energy]
    controls: tuple[Control, ...]
    weights: dict[str, Float[AnyArray, ""]]

    def __init__(
        self,
        character: Character,
        motion: Motion,
        terms: Mapping[str, Term | Energy],
        controls: tuple[Control, ...] = (),
        weights: Mapping[str, float | AnyArray] | None = None,
    ):
        unknown = set(weights or {}) - set(terms)
        if unknown:
            raise InputError(f"weights for unknown terms {sorted(unknown)}; terms: {', '.join(terms)}")
        names = [c.name for c in controls]
        if len(set(names)) != len(names):
            raise InputError(f"control names must differ, got {', '.join(names)}")
        if len(motion.skeleton.names) != len(character.skeleton.names):
            raise InputError(f"the motion has {len(motion.skeleton.names)} joints, the character "
                             f"{len(character.skeleton.names)}; put it on with motionfit.onto(motion, skeleton)")  # fmt: skip
        self.character, self.motion, self.terms, self.controls = character, motion, dict(terms), tuple(controls)
        self.weights = {k: _array((weights or {}).get(k, 1.0)) for k in terms}

    def objective(self, terms: Sequence[str] | None = None) -> "Objective":
        """What a solver sees of some terms (None: all): arrays without names, and without the skin."""
        names = tuple(self.terms) if terms is None else tuple(terms)
        controls = tuple(dataclasses.replace(c, name="") for c in self.controls)
        return Objective(self.character.skeleton, self.motion, controls, tuple(self.terms[k] for k in names),
                         tuple(self.weights[k] for k in names))  # fmt: skip

    def kinematics(self, signals: Float[AnyArray, "frames controls"] | None = None) -> Kinematics:
        """Forward kinematics of the base motion with control signals [rad] on top (None: the base motion)."""
        return self.objective(()).kinematics(signals)

    def costs(self, correction: Correction | None = None) -> dict[str, float]:
        """The weighted cost of each term, 1/2 w sum r^2 or w E."""
        costs = _costs(self.objective(), self._points(correction))
        return {k: float(v) for k, v in zip(self.terms, costs, strict=True)}

    def _points(self, correction: Correction | None) -> tuple[Array, ...]:
        """A correction's control points, by name; those of a whole clip, on the same knots as its padded length that a
        solver sees, are filled up with zeros."""
        if correction is None:
            return tuple(jnp.zeros(c.basis.count) for c in self.controls)
        had = {c.name: p for c, p in zip(correction.controls, correction.points, strict=True)}
        missing = [c.name for c in self.controls if c.name not in had or len(had[c.name]) > c.basis.count]
        if missing:
            raise InputError(f"the correction does not fit the problem's control {', '.join(missing)}; it has "
                             f"{', '.join(had) or 'none'}")  # fmt: skip
        return tuple(jnp.pad(jnp.asarray(had[c.name]), (0, c.basis.count - len(had[c.name]))) for c in self.controls)

    def report(self, correction: Correction | None = None) -> str:
        """A table of the terms: weight, cost and the frame where it is worst."""
        lines = [f"{'term':<28} {'weight':>9} {'cost':>12}  worst frame"]
        costs, frames = self.costs(correction), _worst_frames(self.objective(), self._points(correction))
        for (name, cost), frame in zip(costs.items(), frames, strict=True):
            worst = "-" if frame is None else str(int(frame))
            lines.append(f"{name:<28} {float(self.weights[name]):>9.3g} {cost:>12.5g}  {worst}")
        return "\n".join(lines)


class Objective(eqx.Module):
    """Skeleton, base motion, controls, terms and weights: a problem stripped of names, so that blocks of equal
    structure, such as the left and the right arm, share one compiled program whatever character they belong to."""

    skeleton: Skeleton
    motion: Motion
    controls: tuple[Control, ...]
    terms: tuple[Term | Energy, ...]
    weights: tuple[Float[AnyArray, ""], ...]

    def signals(self, points: tuple[Float[AnyArray, " _"], ...]) -> Float[Array, "frames controls"]:
        """The value of every control in every frame [rad]."""
        if not self.controls:
            return jnp.zeros((self.motion.root.shape[0], 0))
        return jnp.stack([c.signal(p) for c, p in zip(self.controls, points, strict=True)], axis=1)

    def kinematics(self, signals: Float[AnyArray, "frames controls"] | None = None) -> Kinematics:
        motion = self.motion
        if signals is not None and self.controls:
            rotations = turned(motion, self.controls, signals)
            motion = Motion(motion.skeleton, motion.root, rotations, motion.dt, motion.translations)
        else:
            signals = jnp.zeros((motion.root.shape[0], len(self.controls)))
        return forward_kinematics(self.skeleton, motion, signals)

    def costs(self, points: tuple[Float[AnyArray, " _"], ...]) -> tuple[Float[Array, ""], ...]:
        """1/2 w sum r^2 or w E of each term: the cost convention of _types.py."""
        kin = self.kinematics(self.signals(points))
        return tuple(jnp.asarray(w) * term_cost(t, kin) for t, w in zip(self.terms, self.weights, strict=True))


@eqx.filter_jit
def _costs(objective: Objective, points) -> tuple[Array, ...]:
    return objective.costs(points)


@eqx.filter_jit  # one program: op by op, a first report compiled some hundred and fifty
def _worst_frames(objective: Objective, points) -> tuple[Array | None, ...]:
    """The frame in which the residuals of each term are largest; None for an energy."""
    kin = objective.kinematics(objective.signals(points))

    def worst(term: Term | Energy) -> Array | None:
        if isinstance(term, Energy):
            return None
        rows = term.residual(kin)
        return jnp.argmax(jnp.sum(jnp.square(rows.reshape(rows.shape[0], -1)), axis=1))

    return tuple(worst(term) for term in objective.terms)


def term_cost(term: Term | Energy, kin: Kinematics) -> Float[Array, ""]:
    """1/2 sum r^2 of a term, or the energy itself: see the cost convention in _types.py."""
    if isinstance(term, Energy):
        return term.energy(kin)
    return 0.5 * jnp.sum(jnp.square(term.residual(kin)))

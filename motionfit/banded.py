"""A linear solver for least squares that are banded in time: linear in the clip's length.

A control point touches only the frames under its spline's support, and a row of frame t only the few control points
around t. So the Jacobian needs a handful of products whatever the clip's length: control points that are `width`
apart share no row, and one product serves them all (Curtis, Powell & Reid 1974). Their normal matrix, with the
control points of all controls interleaved in time, is block tridiagonal, and is factorised block after block.

The libraries asdex and sparsejac colour general sparsity patterns. Here the pattern is known in closed form, the
products must stay traceable inside an optimistix solver, and the columns must come out grouped by time, not as a
sparse matrix: they would add a dependency and save nothing.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import Array
from jaxtyping import Float, Int, PyTree

from motionfit._types import AnyArray
from motionfit.splines import Basis

FRAMES_AT_ONCE = 24_000  # of all products that are formed together: some 10 kB each


class Banded(lx.AbstractLinearSolver):
    """Solves `min |A x - b|` where x is a tuple of control points, one array per control, all on one basis.

    A row of frame t touches only the control points `first[t]` .. `first[t] + width - 1` of each control. Rows are
    arrays with the frames first. Two more kinds of operators are understood: the damped ones of optimistix, whose
    output is (rows, sqrt(lambda) x), and square symmetric ones from x to x, such as the Hessian of an implicit
    derivative. Made by `Banded.of`. A rank deficient matrix is kept factorisable by a small ridge.

    Of the first `local` arrays of rows it is known that frame t sees the *signals* of frame t only. A control's
    columns are then multiples of one column per frame, and products of n rows are needed per control, not per pair of
    control points.
    """

    first: Int[AnyArray, " frames"]
    frames_of: Int[AnyArray, "points rows"]
    width: int = eqx.field(static=True)
    local: int = eqx.field(static=True, default=0)

    @classmethod
    def of(cls, basis: Basis, reach: int = 0, local: int = 0) -> "Banded":
        """The solver for rows of frame t that see the signals of frames t - reach .. t + reach."""
        last = np.asarray(basis.first)
        frames = len(last)
        low = last[np.maximum(np.arange(frames) - reach, 0)]
        high = last[np.minimum(np.arange(frames) + reach, frames - 1)] + basis.values.shape[1]
        width = min(int((high - low).max()), basis.count)
        # windows must not run past the last control point
        first = np.minimum(low, basis.count - width).astype(np.int32)
        order = np.argsort(first, kind="stable")
        counts = np.bincount(first, minlength=basis.count)
        frames_of = np.full((basis.count, max(int(counts.max()), 1)), frames, np.int32)
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        frames_of[first[order], np.arange(frames) - starts[first[order]]] = order
        return cls(first, frames_of, width, local)

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]):
        del options
        unknowns, rows = operator.in_structure(), operator.out_structure()
        controls, points = _size(unknowns)
        if jax.tree.structure(rows) == jax.tree.structure(unknowns) and _shapes(rows) == _shapes(unknowns):
            band = self._symmetric_band(operator, controls, points)
        else:
            band = self._normal_band(operator, controls, points)
        return _factorise(band, self.width), operator

    def compute(self, state, vector: PyTree[Array], options: dict[str, Any]):
        del options
        factors, operator = state
        unknowns = operator.in_structure()
        controls, points = _size(unknowns)
        if _shapes(operator.out_structure()) == _shapes(unknowns):
            right = jnp.stack(jax.tree.leaves(vector), axis=1)
        else:
            right = jnp.stack(jax.tree.leaves(operator.T.mv(vector)), axis=1)
        solution = _substitute(factors, right)[:points]
        structure = jax.tree.structure(unknowns)
        return jax.tree.unflatten(structure, list(solution.T)), lx.RESULTS.successful, {}

    def transpose(self, state, options: dict[str, Any]):
        factors, operator = state
        if _shapes(operator.out_structure()) != _shapes(operator.in_structure()):
            raise NotImplementedError("Banded solves tall systems by their normal equations; they have no transpose")
        return (factors, operator), options

    def conj(self, state, options: dict[str, Any]):
        return state, options

    def assume_full_rank(self) -> bool:
        return True

    def columns(self, operator, controls: int, points: int, period: int) -> list[Array]:
        """One product per control and colour: leaves (controls * period, ...)."""
        unknowns = operator.in_structure()
        seeds = _seeds(controls, points, period, jax.tree.leaves(unknowns)[0].dtype)
        tree = jax.tree.unflatten(jax.tree.structure(unknowns), [seeds[:, c] for c in range(controls)])
        return jax.tree.leaves(jax.vmap(operator.mv)(tree))

    def columns_of(self, x: tuple[Array, ...], product: Callable) -> tuple[Array, ...]:
        """All that is not zero of the Jacobian of rows (frames, n), by control and colour: (controls * width, frames, n)
        each. `product` gives the rows' tangent for one of the control points x."""
        seeds = _seeds(len(x), len(x[0]), self.width, x[0].dtype)
        # as many products at once as memory bears: for a long clip one or a few
        parts = [p for p in range(1, len(seeds) + 1) if len(seeds) % p == 0]
        part = max((p for p in parts if p * len(self.first) <= FRAMES_AT_ONCE), default=1)
        products = jax.vmap(lambda seed: product((*seed,)))
        if part == len(seeds):
            return products(seeds)
        columns = jax.lax.map(products, seeds.reshape(-1, part, *seeds.shape[1:]))
        return jax.tree.map(lambda c: c.reshape(-1, *c.shape[2:]), columns)

    def times(self, columns: tuple[Array, ...], x: tuple[Array, ...]) -> tuple[Array, ...]:
        """The product of such a Jacobian with control points."""
        order = np.arange(self.width, dtype=np.int32) - jnp.asarray(self.first)[:, None]
        own = jnp.stack(x, axis=0)[
            :, jnp.asarray(self.first)[:, None] + order % self.width
        ]  # (controls, frames, width)
        own = jnp.moveaxis(own, 2, 1).reshape(-1, own.shape[1])
        return jax.tree.map(lambda c: jnp.einsum("kt,ktn->tn", own, c), columns)

    def windows(self, rows: Float[Array, "colours frames n"], controls: int) -> Float[Array, "points window rows"]:
        """Jacobian rows by the control point that their window starts at: (points, width * controls, rows * n)."""
        width, frames = self.width, rows.shape[1]
        rows = rows.reshape(controls, width, frames, -1)
        place = (jnp.asarray(self.first)[None] + np.arange(width, dtype=np.int32)[:, None]) % width
        rows = jnp.take_along_axis(rows, place[None, :, :, None], axis=1)
        rows = jnp.pad(rows, ((0, 0), (0, 0), (0, 1), (0, 0)))  # the row that fills up short windows
        grouped = rows[:, :, jnp.asarray(self.frames_of)]  # (controls, width, points, frames of a window, n)
        grouped = jnp.transpose(grouped, (2, 1, 0, 3, 4))
        return grouped.reshape(grouped.shape[0], width * controls, -1)

    def _normal_band(self, operator, controls: int, points: int) -> Float[Array, "points width controls controls"]:
        width = self.width
        leaves = self.columns(operator, controls, points, width)
        damped = isinstance(operator.out_structure(), tuple) and len(operator.out_structure()) == 2
        damped = damped and _shapes(operator.out_structure()[1]) == _shapes(operator.in_structure())
        damping = leaves[-controls:] if damped else []
        rows = leaves[: len(leaves) - len(damping)]
        gram = 0.0
        for k, leaf in enumerate(rows):
            columns = leaf.reshape(controls, width, leaf.shape[1], -1)
            gram = gram + (_gram_of_multiples(columns) if k < self.local else _gram(columns))
        # from the order of colours to that of a frame's own control points, then all frames of one window together
        place = (jnp.asarray(self.first)[:, None] + np.arange(width, dtype=np.int32)) % width
        gram = jnp.take_along_axis(gram, place[:, :, None, None, None], axis=1)
        gram = jnp.take_along_axis(gram, place[:, None, None, :, None], axis=3)
        gram = jnp.pad(gram, ((0, 1), *((0, 0),) * 4))
        squares = jnp.sum(gram[jnp.asarray(self.frames_of)], axis=1)
        band = []
        for i in range(width):  # the blocks that couple a control point with the i-th after it
            shifted = [jnp.pad(squares[:, p, :, p + i, :], ((p, 0), (0, 0), (0, 0)))[:points] for p in range(width - i)]
            band.append(sum(shifted))
        if damping:
            # each damping row is one control point's own: its square lies on the diagonal
            own = jnp.stack([jnp.sum(jnp.square(leaf), axis=0) for leaf in damping], axis=-1)
            band[0] = band[0] + own[:, :, None] * jnp.eye(controls, dtype=own.dtype)
        return jnp.stack(band, axis=1)

    def _symmetric_band(self, operator, controls: int, points: int) -> Float[Array, "points width controls controls"]:
        """The band of a symmetric operator: control point k sees k - width + 1 .. k + width - 1."""
        period = min(2 * self.width - 1, points)
        leaves = self.columns(operator, controls, points, period)
        rows = jnp.stack(leaves, axis=-1).reshape(controls, period, points, controls)
        band = []
        for i in range(self.width):
            colour = (np.arange(points) + i) % period
            block = jnp.take_along_axis(rows, jnp.asarray(colour)[None, None, :, None], axis=1)[
                :, 0
            ]  # (column c, point, row c)
            exists = (np.arange(points) + i < points)[:, None, None]
            band.append(jnp.where(exists, jnp.transpose(block, (1, 2, 0)), 0.0))
        return jnp.stack(band, axis=1)


def _gram(columns: Float[Array, "controls width frames n"]) -> Float[Array, "frames width controls width controls"]:
    """Products of all columns within each frame."""
    controls, width, frames, _ = columns.shape
    rows = jnp.transpose(columns, (2, 1, 0, 3)).reshape(frames, width * controls, -1)
    return jnp.einsum("tin,tjn->tij", rows, rows).reshape(frames, width, controls, width, controls)


def _gram_of_multiples(
    columns: Float[Array, "controls width frames n"],
) -> Float[Array, "frames width controls width controls"]:
    """The same where a control's columns of one frame are multiples of their sum."""
    total = jnp.sum(columns, axis=1)
    size = jnp.sum(jnp.square(total), axis=-1)
    share = jnp.sum(columns * total[:, None], axis=-1) / jnp.where(size > 0.0, size, 1.0)[:, None]
    products = jnp.einsum("ctn,dtn->tcd", total, total)
    return jnp.einsum("cpt,dqt,tcd->tpcqd", share, share, products)


def _seeds(controls: int, points: int, period: int, dtype) -> Float[Array, "colours controls points"]:
    colours = (np.arange(points)[None] % period == np.arange(period)[:, None]).astype(float)
    seeds = np.einsum("cd,pk->cpdk", np.eye(controls), colours).reshape(controls * period, controls, points)
    return jnp.asarray(seeds, dtype)


def _size(unknowns) -> tuple[int, int]:
    leaves = jax.tree.leaves(unknowns)
    return len(leaves), leaves[0].shape[0]


def _shapes(tree) -> list:
    return [leaf.shape for leaf in jax.tree.leaves(tree)]


def _factorise(band: Float[Array, "points width controls controls"], width: int):
    """Cholesky factors of the block tridiagonal matrix, one `lax.scan` over its blocks.

    A block holds `group` >= width - 1 control points, so that only neighbouring blocks couple.
    """
    points, _, controls, _ = band.shape
    group = max(width - 1, 1)
    blocks = -(-points // group)
    size = group * controls
    padded = jnp.pad(band, ((0, blocks * group - points), (0, 0), (0, 0), (0, 0)))
    # control points that only fill up the last block stand for themselves
    filling = (jnp.arange(blocks * group) >= points).astype(band.dtype)
    largest = jnp.max(jnp.abs(jnp.diagonal(padded[:, 0], axis1=1, axis2=2)))
    ridge = 4 * jnp.finfo(band.dtype).eps * largest + jnp.finfo(band.dtype).tiny ** 0.5
    own = padded[:, 0] + (filling[:, None, None] + ridge) * jnp.eye(controls, dtype=band.dtype)
    padded = padded.at[:, 0].set(own).reshape(blocks, group, width, controls, controls)

    here, there = np.meshgrid(np.arange(group), np.arange(group), indexing="ij")
    ahead = there - here
    strictly = jnp.where((ahead > 0)[:, :, None, None], padded[:, here, np.clip(ahead, 0, width - 1)], 0.0)
    strictly = strictly.transpose(0, 1, 3, 2, 4).reshape(blocks, size, size)
    own = jnp.einsum("bgcd,gh->bgchd", padded[:, :, 0], jnp.eye(group, dtype=band.dtype)).reshape(blocks, size, size)
    diagonal = own + strictly + jnp.swapaxes(strictly, 1, 2)
    ahead = group + there - here
    valid = (ahead < width)[:, :, None, None]
    coupling = jnp.where(valid, padded[:, here, np.clip(ahead, 0, width - 1)], 0.0)
    coupling = coupling.transpose(0, 1, 3, 2, 4).reshape(blocks, size, size)

    def step(carried, block):
        own, next_ = block
        factor = jnp.linalg.cholesky(own - carried)
        # a pivot lost to rounding: leave these unknowns where they are instead of returning NaN
        factor = jnp.where(jnp.all(jnp.isfinite(factor)), factor, jnp.eye(size, dtype=own.dtype) * largest)
        linked = jax.scipy.linalg.solve_triangular(factor, next_, lower=True)
        return linked.T @ linked, (factor, linked)

    _, factors = jax.lax.scan(step, jnp.zeros((size, size), band.dtype), (diagonal, coupling))
    return factors


def _substitute(factors, right: Float[Array, "points controls"]) -> Float[Array, "padded controls"]:
    factor, linked = factors
    blocks, size, _ = factor.shape
    controls = right.shape[1]
    right = jnp.pad(right, ((0, blocks * size // controls - right.shape[0]), (0, 0))).reshape(blocks, size)

    def forward(before, block):
        factor, linked, right = block
        solved = jax.scipy.linalg.solve_triangular(factor, right - before, lower=True)
        return linked.T @ solved, solved

    def backward(after, block):
        factor, linked, solved = block
        value = jax.scipy.linalg.solve_triangular(factor, solved - linked @ after, lower=True, trans=1)
        return value, value

    zero = jnp.zeros(size, right.dtype)
    _, solved = jax.lax.scan(forward, zero, (factor, linked, right))
    _, values = jax.lax.scan(backward, zero, (factor, linked, solved), reverse=True)
    return values.reshape(-1, controls)

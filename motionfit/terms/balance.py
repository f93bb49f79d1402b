"""Terms that keep a motion as balanced as it was."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from motionfit._motion import Kinematics
from motionfit._problem import Term
from motionfit._types import AnyArray
from motionfit.balance import FLIGHT, WINDOW, Soles, support_distance, zero_moment_point
from motionfit.shape.mass import Masses
from motionfit.terms.penetration import hinge


def _array(x):
    return jnp.asarray(x, dtype=float) if isinstance(x, float | int) else x


class ZmpMargin(Term):
    """The zero-moment point no farther from the support than in the original motion: d_i of thesis 4.7.3.

    Row t is hinge(distance - scale * threshold) / sigma, with the signed distance to the hull of the soles planted in
    frame t. `threshold` [m] are the zmp_i of 4.7.2, `motionfit.balance.zmp_distance(...).outside` of the original
    motion on the original body (0: back into the support); `scale` below 1 asks for more balance than the original
    had, and below 0.9 it looks like a cartoon. Negative thresholds ask for a margin inside. `planted` says which foot
    (left, right) is down; frames without one, and frames of flight, ask for nothing. `sigma` [m]; `width` [m] rounds
    the hinge's corner. With `spin` the segments' own angular momentum counts.

    A row looks at the accelerations of the frames around it. `frames_around` says at how many on each side, so that the
    block that it stands in is solved banded; five windows are enough for the filter's Gaussian to fall to 4e-6. None:
    all of them, densely.
    """

    masses: Masses
    soles: Soles
    planted: Bool[AnyArray, "frames feet"]
    threshold: Float[AnyArray, "*frames"]
    scale: Float[AnyArray, ""] = eqx.field(converter=_array, default=1.0)
    sigma: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.01)
    width: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.002)
    ground: Float[AnyArray, "*frames"] = eqx.field(converter=_array, default=0.0)
    window: Float[AnyArray, ""] = eqx.field(converter=_array, default=WINDOW)
    spin: bool = eqx.field(static=True, default=True)
    frames_around: int | None = eqx.field(static=True, default=None)

    @property
    def reach(self) -> int | None:
        return self.frames_around

    def residual(self, kin: Kinematics) -> Float[Array, "frames"]:
        zmp = zero_moment_point(kin, self.masses, spin=self.spin, ground=self.ground, window=self.window)
        signed = support_distance(zmp.point_world, self.soles.corners_world(kin), self.planted)
        rows = hinge(signed - self.scale * jnp.asarray(self.threshold), self.width) / self.sigma
        # fades in from flight, so that a frame at the limit does not jump
        carried = jnp.clip((zmp.load - FLIGHT) / (0.5 * FLIGHT), 0.0, 1.0)
        return jnp.where(jnp.any(jnp.asarray(self.planted), axis=1), carried * rows, 0.0)


class Standing(Term):
    """Another term, seen on the body moved as a whole so that its feet stay at `home_world` [m].

    A control that turns thighs and feet moves the feet under the hips. Those who stand do it the other way round: the
    feet stay, and the body leans over the ankles. `share` says per frame how much each foot counts (they sum to one).
    """

    term: Term
    feet: tuple[int, ...] = eqx.field(static=True)
    home_world: Float[AnyArray, "frames feet 3"]
    share: Float[AnyArray, "frames feet"]

    @property
    def reach(self) -> int | None:
        return self.term.reach

    def shift(self, positions_world: Float[AnyArray, "frames joints 3"]) -> Float[Array, "frames 3"]:
        """How far [m] the whole body has to move in each frame."""
        gap = jnp.asarray(self.home_world) - jnp.asarray(positions_world)[:, np.array(self.feet)]
        return jnp.sum(jnp.asarray(self.share)[..., None] * gap, axis=1)

    def residual(self, kin: Kinematics) -> Float[Array, "frames ..."]:
        positions = jnp.asarray(kin.positions_world)
        moved = positions + self.shift(positions)[:, None].astype(positions.dtype)
        return self.term.residual(eqx.tree_at(lambda k: k.positions_world, kin, moved))

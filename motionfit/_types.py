"""The glossary: axis names, units, frames, quaternion order, the cost convention; and the one error type.

Axis names of the jaxtyping annotations
    frames, joints, vertices, faces, ends (end sites), controls, points (sampled skin points), pairs.

Units and frames
    metres, seconds, radians, kilograms; y up, +z forward, right-handed.
    `x_world` is in the world frame, `x_parent` in the parent joint's frame, `x_bind` in the character's bind pose.
    Quaternions are unit, in the order w, x, y, z. A rotation `rotations_parent` takes joint coordinates to
    the parent's coordinates.

Cost
    cost = sum_k weight_k * 1/2 * sum(residual_k ** 2) + sum_k weight_k * energy_k.
    A residual is dimensionless: it was divided by a `sigma` that carries the unit ("5 mm counts as 1").
    `weight` is dimensionless and enters linearly.

Host and device
    Files are read into float64 NumPy arrays, so that writing them again loses nothing; whatever goes through a
    jitted function comes back in JAX's working precision (float32, or float64 when x64 is on).
"""

from typing import TypeAlias

import numpy as np
from jax import Array
from jaxtyping import Float, Int

AnyArray: TypeAlias = Array | np.ndarray

Vec3: TypeAlias = Float[AnyArray, "3"]
Quat: TypeAlias = Float[AnyArray, "4"]
Positions: TypeAlias = Float[AnyArray, "frames joints 3"]
Rotations: TypeAlias = Float[AnyArray, "frames joints 4"]
Vertices: TypeAlias = Float[AnyArray, "vertices 3"]
Faces: TypeAlias = Int[AnyArray, "faces 3"]


class InputError(ValueError):
    """Bad input, said in one line: which file or argument, what is wrong and where, and what to do.

    The command line prints it on stderr and exits with status 2.
    """

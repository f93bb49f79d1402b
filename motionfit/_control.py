"""The extra animation layer of thesis 4.3: controls that drive joints, and the correction that sets them."""

import dataclasses
import json
import pathlib
import zipfile

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from motionfit import rotation
from motionfit._files import whole
from motionfit._motion import Motion
from motionfit._types import AnyArray, InputError
from motionfit.splines import Basis


class Drive(eqx.Module):
    """One joint that a control turns: `axis_parent` in the joint's *parent's* frame, unit, one for all frames or
    one per frame, and a gain (-1 for the mirrored thigh, for the head that undoes the hip).

    The joint is an index array, not static: the left and the right arm share one compiled program.
    """

    joint: Int[AnyArray, ""] = eqx.field(converter=lambda x: np.asarray(x, np.int32) if isinstance(x, int) else x)
    axis_parent: Float[AnyArray, "*frames 3"]
    gain: Float[AnyArray, ""] = eqx.field(converter=lambda x: np.asarray(x, float) if isinstance(x, float | int) else x)


class Control(eqx.Module):
    """One scalar signal over time [rad], held by spline control points, that drives one or more joints.

    Control points are clamped to `lower`..`upper` [rad], thesis 4.3.1: the clamped value is interpolated smoothly
    between its neighbours, so a bound makes no discontinuity.
    """

    name: str = eqx.field(static=True)
    drives: tuple[Drive, ...]
    basis: Basis
    lower: Float[AnyArray, ""] = eqx.field(
        converter=lambda x: np.asarray(x, float) if isinstance(x, float | int) else x, default=-np.pi / 2
    )
    upper: Float[AnyArray, ""] = eqx.field(
        converter=lambda x: np.asarray(x, float) if isinstance(x, float | int) else x, default=np.pi / 2
    )

    def __getitem__(self, frames: Int[np.ndarray, " some"]) -> "Control":
        """The same control in some frames only."""
        drives = tuple(dataclasses.replace(d, axis_parent=d.axis_parent[frames]) if np.ndim(d.axis_parent) == 2 else d
                       for d in self.drives)  # fmt: skip
        return dataclasses.replace(self, drives=drives, basis=self.basis[frames])

    def signal(self, points: Float[AnyArray, " points"]) -> Float[Array, " frames"]:
        """The control's value in each frame [rad]."""
        return self.basis(jnp.clip(points, self.lower, self.upper))

    def signal_on_host(self, points: Float[AnyArray, " points"]) -> Float[np.ndarray, " frames"]:
        """`signal` in double precision whatever JAX's mode is, without compiling anything for each length of clip."""
        clamped = np.clip(np.asarray(points, float), np.asarray(self.lower), np.asarray(self.upper))
        values = np.asarray(self.basis.values, float)
        own = np.asarray(self.basis.first)[:, None] + np.arange(values.shape[1])
        return (clamped[own] * values).sum(axis=1)


def turned(
    motion: Motion, controls: tuple[Control, ...], signals: Float[AnyArray, "frames controls"]
) -> Float[Array, "frames joints 4"]:
    """The motion's rotations with the controls on top: q'_j = exp(sum over drives of gain * signal * axis) q_j.

    The rotation vectors of all drives of a joint are summed before the exponential: their order does not matter,
    and where all of them are zero the motion's own rotation comes back bit for bit.
    """
    rotations = jnp.asarray(motion.rotations)
    driven = [(k, drive) for k, control in enumerate(controls) for drive in control.drives]
    if not driven:
        return rotations
    joints = jnp.stack([jnp.asarray(drive.joint) for _, drive in driven])
    pushes = jnp.stack(
        [(signals[:, k] * d.gain)[:, None] * jnp.asarray(d.axis_parent).reshape(-1, 3) for k, d in driven], axis=1
    )
    # drives of one joint add up; each of them then writes the same rotation
    together = (joints[:, None] == joints[None, :]).astype(pushes.dtype)
    vectors = jnp.einsum("de,tea->tda", together, pushes).astype(rotations.dtype)
    # exp(0) is the identity exactly, and multiplying by it changes no bit
    return rotations.at[:, joints].set(rotation.multiply(rotation.exp(vectors), rotations[:, joints]))


class Correction(eqx.Module):
    """The control points of all controls [rad]: the unknowns of the fit, and its result.

    `correction["left_arm"]` are the control points of one control. `apply` puts the correction on a motion
    without solving anything.
    """

    controls: tuple[Control, ...]
    points: tuple[Float[AnyArray, " _"], ...]  # controls may have bases of their own

    @classmethod
    def zero(cls, controls: tuple[Control, ...]) -> "Correction":
        return cls(controls, tuple(jnp.zeros(c.basis.count) for c in controls))

    def __getitem__(self, name: str) -> Float[AnyArray, " points"]:
        names = [c.name for c in self.controls]
        if name not in names:
            raise KeyError(f"no control {name!r}; controls: {', '.join(names)}")
        return self.points[names.index(name)]

    def signals(self) -> Float[Array, "frames controls"]:
        """The value of every control in every frame [rad]."""
        return jnp.stack([c.signal(p) for c, p in zip(self.controls, self.points, strict=True)], axis=1)

    def apply(self, motion: Motion) -> Motion:
        """The corrected motion. Frames and joints that no control moves are the motion's own, bit for bit."""
        if not self.controls:
            return motion
        frames = self.controls[0].basis.first.shape[0]
        if frames != motion.frame_count:
            raise InputError(f"the correction was made for {frames} frames, the motion has {motion.frame_count}")
        if isinstance(motion.rotations, np.ndarray):
            rotations = _turned_on_host(motion, self)
        else:
            rotations = turned(motion, self.controls, self.signals())
        return Motion(motion.skeleton, motion.root, rotations, motion.dt, motion.translations)

    def save(self, path: str | pathlib.Path) -> None:
        """Write the correction to an .npz file: control points, drives, axes and bases."""
        arrays, described = {}, []
        for k, (control, points) in enumerate(zip(self.controls, self.points, strict=True)):
            described.append({"name": control.name, "count": control.basis.count,
                              "joints": [int(d.joint) for d in control.drives]})  # fmt: skip
            arrays |= {f"{k}.points": points, f"{k}.first": control.basis.first, f"{k}.values": control.basis.values,
                       f"{k}.lower": control.lower, f"{k}.upper": control.upper}  # fmt: skip
            for i, drive in enumerate(control.drives):
                arrays |= {f"{k}.{i}.axis": drive.axis_parent, f"{k}.{i}.gain": drive.gain}
        arrays["motionfit_correction"] = np.array(json.dumps(described))
        with whole(path) as partial, open(partial, "wb") as file:
            np.savez(file, **{k: np.asarray(v) for k, v in arrays.items()})  # pyright: ignore[reportArgumentType]: NumPy's stub


def load_correction(path: str | pathlib.Path) -> Correction:
    """Read a correction that `Correction.save` wrote; applied again it gives the same bits."""
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {k: data[k] for k in data.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a readable correction file ({error})") from None
    if "motionfit_correction" not in arrays:
        raise InputError(f"{path}: an .npz file, but not a correction; write one with fit.correction.save(path)")
    controls, points = [], []
    for k, c in enumerate(json.loads(str(arrays["motionfit_correction"]))):
        drives = tuple(Drive(j, arrays[f"{k}.{i}.axis"], arrays[f"{k}.{i}.gain"]) for i, j in enumerate(c["joints"]))
        basis = Basis(arrays[f"{k}.first"], arrays[f"{k}.values"], c["count"])
        controls.append(Control(c["name"], drives, basis, arrays[f"{k}.lower"], arrays[f"{k}.upper"]))
        points.append(arrays[f"{k}.points"])
    return Correction(tuple(controls), tuple(points))


def _turned_on_host(motion: Motion, correction: Correction) -> Float[np.ndarray, "frames joints 4"]:
    """`turned`, as `Control.signal_on_host` is `signal`."""
    vectors: dict[int, np.ndarray] = {}
    for control, points in zip(correction.controls, correction.points, strict=True):
        signal = control.signal_on_host(points)
        for drive in control.drives:
            push = signal[:, None] * float(drive.gain) * np.asarray(drive.axis_parent, float).reshape(-1, 3)
            vectors[int(drive.joint)] = vectors.get(int(drive.joint), 0.0) + push
    rotations = np.array(motion.rotations)
    for joint, vector in vectors.items():
        moved = vector.any(axis=1)
        if not moved.any():
            continue
        own = Rotation.from_quat(np.asarray(rotations[moved, joint], float), scalar_first=True)
        rotations[moved, joint] = (Rotation.from_rotvec(vector[moved]) * own).as_quat(scalar_first=True)
    return rotations

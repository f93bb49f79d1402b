"""Write down what a closed form did to a motion, as controls with a value per frame."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from motionfit._control import Control, Correction, Drive
from motionfit._fit import Fit
from motionfit._motion import Motion
from motionfit.adapt._sampling import Sampling
from motionfit.splines import per_frame


def recorded(name: str, motion: Motion, base: Motion, correction: Correction, joints: Sequence[int]) -> Correction:
    """`correction` with one more control per joint, `name_joint`, so that on `base` it gives the rotations of `motion`.

    The rotation vectors of a joint's controls are summed, so what is missing is the whole turn's less the sum.
    """
    controls, points = list(correction.controls), list(correction.points)
    for joint in joints:
        before, after = (Rotation.from_quat(np.asarray(m.rotations, float)[:, joint], scalar_first=True)
                         for m in (base, motion))  # fmt: skip
        missing = (after * before.inv()).as_rotvec()
        for control, some in zip(correction.controls, correction.points, strict=True):
            for drive in control.drives:
                if int(drive.joint) == joint:
                    signal = control.signal_on_host(some) * float(drive.gain)
                    missing = missing - signal[:, None] * np.asarray(drive.axis_parent, float).reshape(-1, 3)
        angle = np.linalg.norm(missing, axis=1)
        axis = missing / np.maximum(angle, 1e-12)[:, None]
        basis = per_frame(base.frame_count)
        label = f"{name}_{base.skeleton.role_of_joint.get(joint, base.skeleton.names[joint])}"
        controls.append(Control(label, (Drive(joint, axis, 1.0),), basis, -np.pi, np.pi))
        points.append(np.concatenate([angle, np.zeros(basis.count - len(angle))]))
    return Correction(tuple(controls), tuple(points))


def put_down(
    name: str, so_far: Fit, motion: Motion, base: Motion, correction: Correction, joints: Sequence[int]
) -> Fit:  # fmt: skip
    """`so_far` with the rotations of `motion`, `recorded` on another `base`; what the clip was made from stays known."""
    whole = recorded(name, motion, base, correction, joints)
    moved = dataclasses.replace(whole.apply(base), source=so_far.motion.source)
    return dataclasses.replace(so_far, correction=whole, motion=moved, base=base)


def on_top(so_far: Fit, mine: Correction, at: Sampling) -> Fit:
    """More controls on top of a fit's motion: those joints whose turns add up with others' get what is missing."""
    mine = Correction(mine.controls, tuple(np.asarray(p)[: at.whole.count] for p in mine.points))
    motion = mine.apply(so_far.motion)
    both = Correction((*so_far.correction.controls, *mine.controls), (*so_far.correction.points, *mine.points))
    base = dataclasses.replace(so_far.base, root=so_far.motion.root)
    joints = sorted({int(d.joint) for c in mine.controls for d in c.drives})
    name = mine.controls[0].name
    return put_down(name, so_far, motion, base, both, joints)

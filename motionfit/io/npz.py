"""motionfit's own lossless motion format: a NumPy archive with the skeleton and the motion."""

import dataclasses
import json
import os
import pathlib
import zipfile

import numpy as np

from motionfit._files import whole
from motionfit._motion import Motion, Source
from motionfit._onto import onto
from motionfit._skeleton import Skeleton
from motionfit._types import InputError
from motionfit.io.bvh import unreadable

KEYS = ("motionfit_motion", "offsets", "rest_rotations", "end_offsets", "root", "rotations", "dt")


def write_npz(path: str | os.PathLike, motion: Motion) -> None:
    """Write a motion without loss: what is read back has the same bits. The source of an adapted clip is written as it
    is on the same skeleton."""
    skeleton = motion.skeleton
    described = {
        "names": skeleton.names, "parents": skeleton.parents, "end_parents": skeleton.end_parents,
        "channels": skeleton.channels, "file_unit": skeleton.file_unit,
        "roles": {role: skeleton.names[joint] for role, joint in skeleton.roles},
        "source_on": None if motion.source is None else motion.source.body,
    }  # fmt: skip
    arrays = {
        "motionfit_motion": np.array(json.dumps(described)), "offsets": skeleton.offsets,
        "rest_rotations": skeleton.rest_rotations, "end_offsets": skeleton.end_offsets,
        "root": motion.root, "rotations": motion.rotations, "dt": motion.dt,
    }  # fmt: skip
    if motion.translations is not None:
        arrays["translations"] = motion.translations
    if motion.source is not None:
        source = onto(motion.source.motion, skeleton)
        arrays |= {"source_root": source.root, "source_rotations": source.rotations}
        if source.translations is not None:
            arrays["source_translations"] = source.translations
    with whole(path) as partial, open(partial, "wb") as file:
        np.savez_compressed(file, **{k: np.asarray(v) for k, v in arrays.items()})  # pyright: ignore[reportArgumentType]: NumPy's stub


def read_npz(path: str | os.PathLike) -> Motion:
    """Read what `write_npz` wrote."""
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {k: data[k] for k in data.files}
    except OSError as error:
        raise InputError(unreadable(path, error)) from None
    except (ValueError, zipfile.BadZipFile, EOFError):
        raise InputError(f"{pathlib.Path(path)}: not a readable .npz archive; it seems damaged") from None
    missing = [k for k in KEYS if k not in arrays]
    if missing:
        raise InputError(f"{pathlib.Path(path)}: an .npz archive without {missing[0]!r}: not one that motionfit wrote; "
                         "AMASS archives are not read yet")  # fmt: skip
    d = json.loads(str(arrays["motionfit_motion"]))
    channels = None if d["channels"] is None else tuple(tuple(c) for c in d["channels"])
    skeleton = Skeleton(
        d["names"], d["parents"], arrays["offsets"], arrays["rest_rotations"], roles=d["roles"],
        end_parents=d["end_parents"], end_offsets=arrays["end_offsets"], channels=channels, file_unit=d["file_unit"],
    )  # fmt: skip
    motion = Motion(skeleton, arrays["root"], arrays["rotations"], arrays["dt"], arrays.get("translations"))
    if "source_root" not in arrays:
        return motion
    source = (arrays["source_root"], arrays["source_rotations"], arrays["dt"], arrays.get("source_translations"))
    return dataclasses.replace(motion, source=Source(Motion(skeleton, *source), d["source_on"]))

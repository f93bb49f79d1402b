"""Files in and out: metres, y up and quaternions wxyz on this side of the door."""

import dataclasses
import os
import pathlib
from collections.abc import Mapping

import numpy as np

from motionfit._character import Character
from motionfit._motion import Motion, Source, bind_pose, resample
from motionfit._skeleton import load_role_mapping
from motionfit._types import InputError
from motionfit.io.bvh import read_bvh, write_bvh
from motionfit.io.npz import read_npz, write_npz

CLIPS = (".bvh", ".glb", ".gltf", ".npz")
CHARACTERS = (".glb", ".gltf")
CLIP = "a motion clip"
LATER = (".dae", ".amc", ".asf", ".c3d", ".fbx")

Roles = Mapping[str, str] | str | os.PathLike | None


def load_motion(
    path: str | os.PathLike,
    *,
    unit: float | None = None,
    up: str | None = None,
    rest_frame: str = "auto",
    roles: Roles = None,
    start: float | None = None,
    end: float | None = None,
    fps: float | None = None,
) -> Motion:
    """Read a motion clip: .bvh, .glb, .gltf, or motionfit's own .npz.

    `unit` [m per file unit] and `up` ("y", "z") override what a BVH seems to use; `rest_frame` says what a
    BVH's skeleton rests in: a first frame in T-pose, or a pose found where the file's is none to stand in ("auto"), the
    first frame ("first"), all angles zero ("none"); `roles` is a mapping role -> joint name, or a JSON
    file with one. `start`, `end` [s] cut the clip and `fps` [1/s] resamples it.
    """
    names = load_role_mapping(roles) if isinstance(roles, str | os.PathLike) else roles
    ending = _ending(path, CLIPS, CLIP)
    if ending == ".bvh":
        motion = read_bvh(path, unit=unit, up=up, rest_frame=rest_frame, roles=names)
    elif ending == ".npz":
        motion = read_npz(path)
    else:
        from motionfit.io.gltf import read_motion

        motion = read_motion(path, rest_frame=rest_frame, roles=names)
    return trim(motion, start=start, end=end, fps=fps, name=str(path))


def trim(
    motion: Motion,
    *,
    start: float | None = None,
    end: float | None = None,
    fps: float | None = None,
    name: str = "clip",
) -> Motion:
    """The clip from `start` to `end` [s] at `fps` [1/s], and its source alike; `name` is what errors call it."""
    if motion.source is not None and (start, end, fps) != (None, None, None):
        source = trim(motion.source.motion, start=start, end=end, fps=fps, name=name)
        cut = trim(dataclasses.replace(motion, source=None), start=start, end=end, fps=fps, name=name)
        return dataclasses.replace(cut, source=Source(source, motion.source.body))
    duration = (motion.frame_count - 1) * float(motion.dt)
    low, high = start or 0.0, duration if end is None else end
    if not 0 <= low <= high or low > duration:
        raise InputError(f"{name}: start {low:g} s and end {high:g} s do not lie in order within its {duration:.3f} s")
    if start is not None or end is not None:
        first, last = round(low / float(motion.dt)), round(min(high, duration) / float(motion.dt))
        motion = motion[first : last + 1]
    if fps is not None:
        if not 1 <= fps <= 1000:
            raise InputError(f"{name}: a frame rate from 1 to 1000 per second is allowed, got {fps:g}")
        motion = resample(motion, fps)
    return motion


def load_character(path: str | os.PathLike, *, roles: Roles = None) -> Character:
    """Read a skinned character: .glb or .gltf; `builtin:average`, `slim`, `heavy` or `child` is made on the spot."""
    if str(path).startswith("builtin:"):
        from motionfit.shape.bodies import builtin_body

        return builtin_body(str(path).removeprefix("builtin:"))
    _ending(path, CHARACTERS, "a character")
    from motionfit.io.gltf import read_character

    return read_character(path, roles=load_role_mapping(roles) if isinstance(roles, str | os.PathLike) else roles)


def save(path: str | os.PathLike, motion: Motion, character: Character | None = None) -> None:
    """Write a motion; the ending chooses the format. .glb and .gltf hold the skinned, animated character, .bvh and
    .npz the motion. All but .bvh hold the source of an adapted clip too. The file is complete or not there."""
    ending = _ending(path, CLIPS, "an output")
    if ending in (".glb", ".gltf"):
        if character is None:
            raise InputError(f"{path}: a {ending} holds a skinned character; call save(path, motion, character), "
                             "or write .bvh or .npz")  # fmt: skip
        from motionfit.io.gltf_write import write_gltf

        write_gltf(path, motion, character)
    elif ending == ".bvh":
        write_bvh(path, motion)
    else:
        write_npz(path, motion)


def _ending(path: str | os.PathLike, allowed: tuple[str, ...], what: str) -> str:
    ending = pathlib.Path(path).suffix.lower()
    if ending in allowed:
        return ending
    if what == CLIP and str(path).startswith("builtin:"):
        raise InputError(f"{path}: built-in clips are made by functions; call motionfit.samples.walk()")
    hint = "is not read yet; convert it to .glb or .bvh" if ending in LATER else f"is not {what}"
    raise InputError(f"{path}: {ending or 'no ending'} {hint}; endings: {', '.join(allowed)}")


def describe(path: str | os.PathLike) -> dict:
    """What a file holds, as plain values: for `motionfit inspect`."""
    found: dict = {"file": str(path)}
    ending = pathlib.Path(path).suffix.lower()
    skeleton = None
    if ending in CHARACTERS or str(path).startswith("builtin:"):
        character = load_character(path)
        skeleton, vertices = character.skeleton, np.asarray(character.skin.vertices_bind)
        found |= {"kind": "character", "vertices": len(vertices), "triangles": len(character.skin.faces),
                  "height_m": round(float(np.ptp(vertices[:, 1])), 4)}  # fmt: skip
        try:
            motion = load_motion(path)
        except InputError:
            motion = None
    else:
        motion = load_motion(path)
        skeleton = motion.skeleton
        found["kind"] = "motion"
    if motion is not None:
        found |= {"frames": motion.frame_count, "frame_rate": round(motion.frame_rate, 4),
                  "duration_s": round((motion.frame_count - 1) * float(motion.dt), 4)}  # fmt: skip
        if ending == ".bvh":
            plain = load_motion(path, rest_frame="none")
            rest, as_read = (np.asarray(m.skeleton.rest_rotations) for m in (motion, plain))
            found |= {"unit_m": motion.skeleton.file_unit, "up": "y" if abs(as_read[0, 0]) > 0.999 else "z"}
            if plain.frame_count > motion.frame_count:
                found["rest_pose"] = "T-pose first frame, not taken for motion"
            elif np.array_equal(rest, as_read):
                found["rest_pose"] = "all angles zero"
            elif np.array_equal(rest[1:], as_read[1:]):
                found["rest_pose"] = "all angles zero, set upright"
            else:
                found["rest_pose"] = "T-pose found from the motion: nobody could stand with all angles zero"
    positions = bind_pose(skeleton)[0]
    roles = {role: skeleton.names[joint] for role, joint in skeleton.roles}
    without = [n for j, n in enumerate(skeleton.names) if j not in skeleton.role_of_joint]
    found |= {"joints": len(skeleton.names), "end_sites": len(skeleton.end_parents),
              "skeleton_height_m": round(float(np.ptp(positions[:, 1])), 4), "roles": roles,
              "joints_without_role": without}  # fmt: skip
    return found

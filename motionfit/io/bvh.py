"""BVH: the hierarchy and the angles as the file has them, units and up-axis to metres and y up."""

import os
import pathlib
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy.spatial.transform import Rotation

from motionfit._files import whole
from motionfit._motion import Motion, host_kinematics
from motionfit._skeleton import Skeleton
from motionfit._types import InputError
from motionfit.io._rest_pose import is_found_again, split_rest_frame, with_standing_rest

CHANNELS = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
CMU_UNIT = 0.0564444  # [m]: ASF lengths of 0.45 make one unit 1/0.45 inch
UNITS = (1.0, 0.01, CMU_UNIT, 0.0254, 0.001)  # [m], tried in this order
HUMAN_LEG = (0.35, 1.25)  # [m] hip to ankle, child to giant
Z_UP = Rotation.from_euler("X", -90, degrees=True)  # takes z up, y back to y up, z forward


class BvhFile(NamedTuple):
    """A BVH file as it stands: lengths in its own unit, angles in degrees."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    channels: tuple[tuple[str, ...], ...]
    end_parents: tuple[int, ...]
    end_offsets: np.ndarray
    frame_time: float
    values: np.ndarray  # (frames, channels)


class _Lines:
    """The file's tokens with the line each stands on, for messages that say where."""

    def __init__(self, path: pathlib.Path, text: str):
        self.path = path
        self.lines = text.splitlines()
        self.at = 0

    def fail(self, what: str, line: int | None = None) -> InputError:
        return InputError(f"{self.path}: line {(self.at if line is None else line) + 1}: {what}")

    def words(self) -> Iterator[list[str]]:
        while self.at < len(self.lines):
            words = self.lines[self.at].split()
            if words:
                yield words
            self.at += 1


def parse_bvh(path: str | os.PathLike) -> BvhFile:
    """Read the file's structure. Line ends, tabs, braces on the same line and number formats do not matter."""
    path = pathlib.Path(path)
    lines = _Lines(path, read_text(path))
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float] | None] = []
    channels: list[tuple[str, ...]] = []
    end_parents: list[int] = []
    end_offsets: list[list[float]] = []
    stack: list[int] = []  # joint indices; -1 - joint for an End Site
    pending: int | None = None
    started = False

    def numbers(words: list[str], count: int) -> list[float]:
        try:
            found = [float(w) for w in words[:count]]
        except ValueError:
            found = []
        if len(found) != count or not np.isfinite(found).all():
            raise lines.fail(f"expected {count} finite numbers, got {' '.join(words[:count]) or 'nothing'!r}")
        return found

    for raw in lines.words():
        # "JOINT name {" on one line is allowed: braces become words of their own
        words = " ".join(raw).replace("{", " { ").replace("}", " } ").split()
        while words:
            key = words[0].upper()
            if key == "HIERARCHY":
                started, words = True, words[1:]
            elif key in ("ROOT", "JOINT", "END"):
                if not started:
                    raise lines.fail("no HIERARCHY before the first joint")
                brace = words.index("{") if "{" in words else len(words)
                if pending is not None:
                    raise lines.fail("a joint without its '{'")
                if key == "END":
                    if not stack:
                        raise lines.fail("an End Site outside of any joint")
                    pending = -1 - stack[-1]
                else:
                    if key == "ROOT" and names:
                        raise lines.fail("a second ROOT; one skeleton per file is read")
                    if key == "JOINT" and (not stack or stack[-1] < 0):
                        raise lines.fail("a JOINT outside of its parent's braces; check the '{' and '}' above")
                    name = " ".join(words[1:brace])
                    if not name:
                        raise lines.fail(f"{words[0]} has no name")
                    names.append(name)
                    parents.append(stack[-1] if stack else -1)
                    offsets.append(None)
                    channels.append(())
                    pending = len(names) - 1
                words = words[brace:]
            elif key == "{":
                if pending is None:
                    raise lines.fail("'{' without a joint before it")
                stack.append(pending)
                pending, words = None, words[1:]
            elif key == "}":
                if not stack:
                    raise lines.fail("'}' without its '{'")
                stack.pop()
                words = words[1:]
            elif key == "OFFSET":
                offset = numbers(words[1:], 3)
                if not stack:
                    raise lines.fail("OFFSET outside of any joint")
                if stack[-1] < 0:
                    end_parents.append(-1 - stack[-1])
                    end_offsets.append(offset)
                else:
                    offsets[stack[-1]] = offset
                words = words[4:]
            elif key == "CHANNELS":
                if not stack or stack[-1] < 0:
                    raise lines.fail("CHANNELS outside of any joint")
                count = words[1] if len(words) > 1 else ""
                if not count.isdigit() or len(words) < 2 + int(count):
                    raise lines.fail(f"CHANNELS announces {count or 'nothing'} but lists {len(words) - 2}")
                named = [w.capitalize() for w in words[2 : 2 + int(count)]]
                wrong = [w for w in named if w not in CHANNELS]
                if wrong:
                    raise lines.fail(f"unknown channel {wrong[0]!r}; channels: {', '.join(CHANNELS)}")
                channels[stack[-1]] = tuple(named)
                words = words[2 + int(count) :]
            elif key == "MOTION":
                break
            else:
                raise lines.fail(f"{words[0][:40]!r} is no BVH keyword" + ("" if started else "; is this a BVH file?"))
        else:
            continue
        break
    else:
        what = "the file is empty" if not lines.lines else f"the file ends without MOTION after {len(names)} joints"
        raise InputError(f"{path}: line {len(lines.lines)}: {what}; it seems cut off")
    if not names:
        raise lines.fail("MOTION without any joint before it")
    if stack or pending is not None:
        raise lines.fail(f"MOTION, but {len(stack)} braces are still open")
    missing = [n for n, o in zip(names, offsets, strict=True) if o is None]
    if missing:
        raise lines.fail(f"joint {missing[0]!r} has no OFFSET")
    lines.at += 1
    frame_time, values = _read_frames(lines, sum(map(len, channels)))
    return BvhFile(
        tuple(names), tuple(parents), np.array(offsets, float), tuple(channels),
        tuple(end_parents), np.array(end_offsets, float).reshape(-1, 3), frame_time, values,
    )  # fmt: skip


def _read_frames(lines: _Lines, width: int) -> tuple[float, np.ndarray]:
    def header(name: str) -> str:
        for words in lines.words():
            text = " ".join(words)
            if not text.lower().startswith(name.lower() + ":"):
                raise lines.fail(f"expected '{name}:', got {text[:40]!r}")
            lines.at += 1
            return text.split(":", 1)[1].strip()
        raise lines.fail(f"the file ends before '{name}:'", len(lines.lines) - 1)

    count_text = header("Frames")
    time_text = header("Frame Time")
    try:
        count, frame_time = int(count_text), float(time_text)
    except ValueError:
        raise lines.fail(f"Frames {count_text!r} or Frame Time {time_text!r} is no number", lines.at - 1) from None
    if count < 1:
        raise lines.fail(f"{count} frames; a motion needs at least one", lines.at - 2)
    if not (np.isfinite(frame_time) and frame_time > 0):
        raise lines.fail(f"Frame Time is {time_text}; it must be above 0 s", lines.at - 1)
    rows = []
    for words in lines.words():
        if len(rows) == count:
            raise lines.fail(f"more rows than the {count} frames announced")
        if len(words) != width:
            raise lines.fail(f"frame {len(rows)} has {len(words)} values, the channels need {width}")
        try:
            row = np.array(words, float)
        except ValueError:
            wrong = next(w for w in words if not _is_number(w))
            raise lines.fail(f"frame {len(rows)} holds {wrong[:20]!r}, which is no number") from None
        if not np.isfinite(row).all():
            raise lines.fail(
                f"frame {len(rows)} holds a value that is not finite in column {int(np.argmin(np.isfinite(row))) + 1}"
            )
        rows.append(row)
    if len(rows) < count:
        raise lines.fail(f"{count} frames announced, {len(rows)} found; the file seems cut off", len(lines.lines) - 1)
    return frame_time, np.array(rows).reshape(count, width)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def read_text(path: pathlib.Path) -> str:
    """The text of a file, or one line that says why it cannot be read."""
    try:
        raw = pathlib.Path(path).read_bytes()
    except OSError as error:
        raise InputError(unreadable(path, error)) from None
    if b"\0" in raw[:4096]:
        raise InputError(f"{path}: line 1: binary data where text was expected; is this really a BVH file?")
    return raw.decode("utf-8", errors="replace").lstrip("\ufeff")


def unreadable(path: str | os.PathLike, error: OSError) -> str:
    """One line for a file that cannot be opened, with near names where it does not exist."""
    path = pathlib.Path(path)
    if isinstance(error, FileNotFoundError):
        import difflib

        beside = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
        near = difflib.get_close_matches(path.name, beside, 3)
        return f"{path}: no such file" + (f"; did you mean {', '.join(near)}?" if near else "")
    if isinstance(error, IsADirectoryError):
        return f"{path}: is a folder; name a file in it"
    return f"{path}: cannot be read ({error.strerror or error}); check its permissions"


# --- to and from Motion -----------------------------------------------------------------------------------------


def read_bvh(
    path: str | os.PathLike,
    *,
    unit: float | None = None,
    up: str | None = None,
    rest_frame: str = "auto",
    roles: Mapping[str, str] | None = None,
) -> Motion:
    """The motion of a BVH file in metres, y up.

    `unit` [m per file unit] and `up` ("y" or "z") override what the skeleton's size and posture suggest.
    `rest_frame`: "auto" takes a first frame in T- or A-pose that the motion does not lead on from for the rest
    pose and not for motion, as in the CMU files; "first" always does, "none" never. With "auto" a
    rest pose that lies is set upright, and where nobody could stand in it a T-pose is found from the motion (of
    skeletons with hips, chest, head and all parts of the limbs).
    """
    file = parse_bvh(path)
    if up not in (None, "y", "z"):
        raise InputError(f"up axis {up!r}; allowed are y and z")
    if unit is not None and not (np.isfinite(unit) and unit > 0):
        raise InputError(f"a unit is metres per file unit, above 0; got {unit}")
    if rest_frame not in ("auto", "first", "none"):
        raise InputError(f"rest_frame {rest_frame!r}; allowed are auto, first, none")
    offsets, root, rotations, translations = _local_transforms(file)
    try:
        skeleton = Skeleton(
            file.names, file.parents, offsets, roles=roles, end_parents=file.end_parents,
            end_offsets=file.end_offsets, channels=file.channels,
        )  # fmt: skip
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    motion = Motion(skeleton, root, rotations, np.asarray(file.frame_time), translations)
    axis = up or _guess_up(motion)
    scale = unit or _guess_unit(motion)
    if axis == "z":
        turned = (Z_UP * Rotation.from_quat(rotations[:, 0], scalar_first=True)).as_quat(scalar_first=True)
        rotations = np.concatenate([turned[:, None], rotations[:, 1:]], axis=1)
        rest = np.array(skeleton.rest_rotations)
        rest[0] = Z_UP.as_quat(scalar_first=True)
        skeleton = eqx.tree_at(lambda s: s.rest_rotations, skeleton, rest)
        root = Z_UP.apply(root)
    skeleton = Skeleton(
        file.names, file.parents, offsets * scale, skeleton.rest_rotations, roles=roles, end_parents=file.end_parents,
        end_offsets=file.end_offsets * scale, channels=file.channels, file_unit=scale,
    )  # fmt: skip
    moved = None if translations is None else translations * scale
    motion = Motion(skeleton, root * scale, rotations, np.asarray(file.frame_time), moved)
    motion = split_rest_frame(motion, rest_frame)
    return with_standing_rest(motion) if rest_frame == "auto" else motion


def _local_transforms(file: BvhFile):
    """Offsets, root path, quaternions and moving translations of a file, in its own unit."""
    frames, joints = len(file.values), len(file.names)
    offsets = file.offsets.copy()
    rotations = np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (frames, joints, 1))
    moved = np.tile(offsets, (frames, 1, 1))
    column = 0
    for joint, channels in enumerate(file.channels):
        values = file.values[:, column : column + len(channels)]
        column += len(channels)
        turns = [k for k, c in enumerate(channels) if c.endswith("rotation")]
        if turns:
            rotations[:, joint] = _compose("".join(channels[k][0] for k in turns), values[:, turns])
        for k, c in enumerate(channels):
            if c.endswith("position"):
                # what a position channel gives is the joint's place in its parent, not an addition to OFFSET
                moved[:, joint, "XYZ".index(c[0])] = values[:, k]
    root = moved[:, 0].copy()
    still = np.ptp(moved, axis=0).max(-1) <= 1e-6 * max(1.0, np.abs(offsets).max())
    for joint in range(1, joints):
        if still[joint]:
            offsets[joint] = moved[0, joint]
    return offsets, root, rotations, (moved if not still[1:].all() else None)


def _compose(order: str, degrees: np.ndarray) -> np.ndarray:
    """Channels Z, Y, X mean R = Rz Ry Rx, whatever the number or order of the axes: (frames, 4)."""
    turn = Rotation.identity(len(degrees))
    if len(order) == 3 and len(set(order)) == 3:
        turn = Rotation.from_euler(order, degrees, degrees=True)
    else:
        for axis, angle in zip(order, degrees.T, strict=True):
            turn = turn * Rotation.from_euler(axis, angle[:, None], degrees=True)
    return turn.as_quat(scalar_first=True)


def _guess_up(motion: Motion) -> str:
    """z where the character stands along z: from hips to head, and from feet to hips, over the first frames."""
    skeleton = motion.skeleton
    positions = host_kinematics(motion[:: max(1, motion.frame_count // 20)])[0]
    low = [j for r in ("left_foot", "right_foot") if (j := skeleton.find(r)) is not None]
    high = skeleton.find("head")
    if not low or high is None:
        return "y"
    extent = (positions[:, high] - positions[:, low].mean(1)).mean(0)
    return "z" if extent[2] > 2 * abs(extent[1]) else "y"


def _guess_unit(motion: Motion) -> float:
    """The unit [m] that makes the legs a human's; 1 m where there are no legs to tell."""
    skeleton = motion.skeleton
    roles = [("left_thigh", "left_calf", "left_foot"), ("right_thigh", "right_calf", "right_foot")]
    for names in roles:
        joints = [skeleton.find(n) for n in names]
        if any(j is None for j in joints):
            continue
        positions = host_kinematics(motion[:1])[0][0]
        hip, knee, ankle = (positions[j] for j in joints if j is not None)
        leg = float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
        fitting = [u for u in UNITS if HUMAN_LEG[0] <= leg * u <= HUMAN_LEG[1]]
        if fitting:
            # several can fit a child or a giant: the one nearest to an adult's leg
            return min(fitting, key=lambda u: abs(np.log(leg * u / 0.85)))
    return 1.0


def write_bvh(path: str | os.PathLike, motion: Motion, *, unit: float | None = None) -> None:
    """Write a motion as BVH, in the unit [m] and channels that its skeleton was read with (else 1 m, Z Y X).

    A skeleton whose rest pose is not the zero pose has it written as the first frame, as the CMU files do, since
    the format has no other place for it; reading takes it out again where the motion does not lead on from it. A rest
    pose that reading would find from the motion itself is not written.
    """
    skeleton = motion.skeleton
    scale = 1.0 / (unit or skeleton.file_unit)
    offsets = np.asarray(skeleton.offsets, float) * scale
    root, rotations = np.asarray(motion.root, float) * scale, np.asarray(motion.rotations, float)
    translations = None if motion.translations is None else np.asarray(motion.translations, float) * scale
    rest = np.asarray(skeleton.rest_rotations, float)
    if np.abs(np.abs(rest[:, 0]) - 1).max() > 1e-9 and not is_found_again(motion):
        rotations, root = np.concatenate([rest[None], rotations]), np.concatenate([root[:1], root])
        if translations is not None:
            translations = np.concatenate([translations[:1], translations])
    channels = skeleton.channels or tuple(
        (CHANNELS[:3] if j == 0 or translations is not None else ()) + ("Zrotation", "Yrotation", "Xrotation")
        for j in range(len(skeleton.names))
    )
    columns = []
    for joint in _depth_first(skeleton):
        named = channels[joint]
        turns = [c for c in named if c.endswith("rotation")]
        angles = _decompose("".join(c[0] for c in turns), rotations[:, joint])
        place = root if joint == 0 else (np.tile(offsets[joint], (len(root), 1)) if translations is None
                                         else translations[:, joint])  # fmt: skip
        for c in named:
            columns.append(angles[:, turns.index(c)] if c in turns else place[:, "XYZ".index(c[0])])
    lines = ["HIERARCHY", *_hierarchy(skeleton, offsets, np.asarray(skeleton.end_offsets, float) * scale, channels)]
    lines += ["MOTION", f"Frames: {len(root)}", f"Frame Time: {float(motion.dt)!r}"]
    table = np.stack(columns, axis=1)
    lines += [" ".join(f"{x:.6f}" for x in row) for row in table + 0.0]
    with whole(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _decompose(order: str, quaternions: np.ndarray) -> np.ndarray:
    turn = Rotation.from_quat(quaternions, scalar_first=True)
    if len(order) == 3 and len(set(order)) == 3:
        import warnings

        with warnings.catch_warnings():
            # at gimbal lock SciPy sets the third angle to zero, which is as good as any
            warnings.simplefilter("ignore", UserWarning)
            angles = turn.as_euler(order, degrees=True)
        return np.rad2deg(np.unwrap(np.deg2rad(angles), axis=0))
    # fewer or doubled axes: the first three of a full order that starts alike; what they cannot hold is lost
    known = list(dict.fromkeys(order))
    full = "".join(known + [a for a in "XYZ" if a not in known])
    angles = np.rad2deg(np.unwrap(turn.as_euler(full, degrees=False), axis=0))
    columns = [angles[:, full.index(a)] if order.index(a) == k else np.zeros(len(angles)) for k, a in enumerate(order)]
    return np.stack(columns, axis=1) if columns else np.zeros((len(angles), 0))


def _depth_first(skeleton: Skeleton) -> list[int]:
    """The order in which a hierarchy lists its joints, which is that of the columns."""

    def below(joint: int) -> list[int]:
        return [joint, *(j for child in skeleton.children(joint) for j in below(child))]

    return below(0)


def _hierarchy(skeleton: Skeleton, offsets, end_offsets, channels) -> list[str]:
    lines: list[str] = []

    def place(x) -> str:
        return " ".join(f"{v:.6f}" for v in x + 0.0)

    def joint(index: int, depth: int) -> None:
        pad = "\t" * depth
        lines.append(f"{pad}{'JOINT' if depth else 'ROOT'} {skeleton.names[index]}")
        lines.append(pad + "{")
        lines.append(f"{pad}\tOFFSET {place(offsets[index])}")
        lines.append(f"{pad}\tCHANNELS {len(channels[index])} {' '.join(channels[index])}".rstrip())
        for child in skeleton.children(index):
            joint(child, depth + 1)
        ends = [k for k, p in enumerate(skeleton.end_parents) if p == index]
        for k in ends:
            lines.extend([f"{pad}\tEnd Site", pad + "\t{", f"{pad}\t\tOFFSET {place(end_offsets[k])}", pad + "\t}"])
        lines.append(pad + "}")

    joint(0, 0)
    return lines

"""The static tree of joints, and the roles by which every algorithm finds them."""

import json
import os
import pathlib
import re
from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from motionfit._remembered import Remembering, remembered
from motionfit._types import AnyArray, InputError

# A role is what a joint *does*. The spine, the neck and nothing else are chains: `spine_0` is the lowest joint
# above the hips, `chest` the joint that carries the shoulders, `neck_0` the lowest neck joint.
LIMB_ROLES = ("clavicle", "upper_arm", "forearm", "hand", "thigh", "calf", "foot", "toe")
SIDES = ("left", "right")
REQUIRED_ROLES = ("hips", "head", *(f"{s}_{r}" for s in SIDES for r in LIMB_ROLES if r not in ("clavicle", "toe")))

# Joint names per convention, lower case without separators, `{s}` for the side's mark. To teach motionfit a new
# rig, add an entry. `{s}` takes the marks of `sides`; `spine` and `neck` list the chains from below.
CONVENTIONS: dict[str, dict] = {
    "MotionBuilder/CMU": {  # also Mixamo, whose `mixamorig:` prefix is stripped, and Rokoko
        "sides": ("left", "right"),
        "hips": ("hips",), "head": ("head",),
        "spine": ("lowerback", "spine", "spine1", "spine2", "spine3", "spine4"),
        "neck": ("neck", "neck1", "neck2"),
        "clavicle": ("{s}shoulder",), "upper_arm": ("{s}arm",), "forearm": ("{s}forearm",), "hand": ("{s}hand",),
        "thigh": ("{s}upleg", "{s}thigh"), "calf": ("{s}leg", "{s}shin"), "foot": ("{s}foot",),
        "toe": ("{s}toebase", "{s}toe"),
    },
    "Character Studio Biped": {
        "sides": ("l", "r"),
        "hips": ("pelvis", "bip01"), "head": ("head",),
        "spine": ("spine", "spine1", "spine2", "spine3"), "neck": ("neck", "neck1"),
        "clavicle": ("{s}clavicle",), "upper_arm": ("{s}upperarm",), "forearm": ("{s}forearm",),
        "hand": ("{s}hand",), "thigh": ("{s}thigh",), "calf": ("{s}calf",), "foot": ("{s}foot",),
        "toe": ("{s}toe0", "{s}toe"),
    },
    "cgspeed 3dsMax": {
        "sides": ("left", "right"),
        "hips": ("hips",), "head": ("head",), "spine": ("chest", "chest2", "chest3", "chest4"), "neck": ("neck",),
        "clavicle": ("{s}collar",), "upper_arm": ("{s}shoulder",), "forearm": ("{s}elbow",),
        "hand": ("{s}wrist",), "thigh": ("{s}hip",), "calf": ("{s}knee",), "foot": ("{s}ankle",),
        "toe": ("{s}toe",),
    },
    "cgspeed DAZ": {
        "sides": ("l", "r"),
        "hips": ("hip",), "head": ("head",), "spine": ("abdomen", "chest"), "neck": ("neck",),
        "clavicle": ("{s}collar",), "upper_arm": ("{s}shldr",), "forearm": ("{s}forearm",), "hand": ("{s}hand",),
        "thigh": ("{s}thigh",), "calf": ("{s}shin",), "foot": ("{s}foot",), "toe": ("{s}toe", "{s}toes"),
    },
    "Blender/Rigify": {  # also Bandai-Namco
        "sides": ("l", "r"),
        "hips": ("pelvis", "hips", "spine"), "head": ("head",),
        "spine": ("spine", "spine001", "spine002", "spine003", "chest"), "neck": ("neck", "neck001", "spine004"),
        "clavicle": ("shoulder{s}",), "upper_arm": ("upperarm{s}",), "forearm": ("forearm{s}", "lowerarm{s}"),
        "hand": ("hand{s}",), "thigh": ("thigh{s}", "upperleg{s}"), "calf": ("shin{s}", "calf{s}", "lowerleg{s}"),
        "foot": ("foot{s}",), "toe": ("toe{s}", "toes{s}"),
    },
    "Unreal": {
        "sides": ("l", "r"),
        "hips": ("pelvis",), "head": ("head",), "spine": ("spine01", "spine02", "spine03", "spine04", "spine05"),
        "neck": ("neck01", "neck02"), "clavicle": ("clavicle{s}",), "upper_arm": ("upperarm{s}",),
        "forearm": ("lowerarm{s}",), "hand": ("hand{s}",), "thigh": ("thigh{s}",), "calf": ("calf{s}",),
        "foot": ("foot{s}",), "toe": ("ball{s}",),
    },
    **{name: {
        "sides": sides,
        "hips": ("pelvis",), "head": ("head",), "spine": ("spine1", "spine2", "spine3"), "neck": ("neck",),
        "clavicle": ("{s}collar",), "upper_arm": ("{s}shoulder",), "forearm": ("{s}elbow",), "hand": ("{s}wrist",),
        "thigh": ("{s}hip",), "calf": ("{s}knee",), "foot": ("{s}ankle",), "toe": ("{s}foot",),
    } for name, sides in (("SMPL", ("l", "r")), ("SMPL-X", ("left", "right")))},
    **{name: {
        "sides": sides,
        **{role: tuple(middle + n for n in names) for role, names in (
            ("hips", ("hips",)), ("head", ("head",)), ("spine", ("spine", "chest", "upperchest")), ("neck", ("neck",)))},
        "clavicle": ("{s}shoulder",), "upper_arm": ("{s}upperarm",), "forearm": ("{s}lowerarm",),
        "hand": ("{s}hand",), "thigh": ("{s}upperleg",), "calf": ("{s}lowerleg",), "foot": ("{s}foot",),
        "toe": ("{s}toes", "{s}toebase"),
    } for name, middle, sides in (("Unity", "", ("left", "right")), ("VRoid", "jbipc", ("jbipl", "jbipr")))},
    "Acclaim (CMU)": {
        "sides": ("l", "r"),
        "hips": ("root", "hips"), "head": ("head",), "spine": ("lowerback", "upperback", "thorax"),
        "neck": ("lowerneck", "upperneck"), "clavicle": ("{s}clavicle",), "upper_arm": ("{s}humerus",),
        "forearm": ("{s}radius",), "hand": ("{s}wrist", "{s}hand"), "thigh": ("{s}femur",), "calf": ("{s}tibia",),
        "foot": ("{s}foot",), "toe": ("{s}toes",),
    },
}  # fmt: skip


def _plain(name: str) -> str:
    """`mixamorig:Left_Arm` -> `leftarm`, `Bip01 L UpperArm` -> `lupperarm`, `spine.001` -> `spine001`."""
    name = re.sub(r"^.*[:|]", "", name).casefold()
    name = re.sub(r"^bip\d+[\s_]+", "", name)
    return re.sub(r"[^a-z0-9]", "", name)


def recognise_roles(
    names: Sequence[str], parents: Sequence[int], mapping: Mapping[str, str] | None = None
) -> dict[str, int]:
    """Role -> joint index, from the convention that explains most of the names.

    `mapping` (role -> joint name) overrides single roles; an unknown role or joint is an `InputError` that lists
    the known ones. The roles that are missing are simply absent: `Skeleton.require` names them.
    """
    plain = [_plain(n) for n in names]
    best: dict[str, int] = {}
    for convention in CONVENTIONS.values():
        found = _match(plain, parents, convention)
        if len(found) > len(best):
            best = found
    for role, joint in (mapping or {}).items():
        known = ["hips", "head", "chest", *(f"{s}_{r}" for s in SIDES for r in LIMB_ROLES)]
        if role not in known and not re.fullmatch(r"(spine|neck)_\d+", role):
            raise InputError(f"unknown role {role!r}; known roles: {', '.join(known)}, spine_N, neck_N")
        if joint not in names:
            raise InputError(f"role {role!r} names joint {joint!r}, which is not there; joints: {', '.join(names)}")
        best = {r: i for r, i in best.items() if i != list(names).index(joint)}
        best[role] = list(names).index(joint)
    return best


def _match(plain: list[str], parents: Sequence[int], convention: dict) -> dict[str, int]:
    def first(candidates: Sequence[str]) -> int | None:
        return next((plain.index(c) for c in candidates if c in plain), None)

    found: dict[str, int] = {}
    for role in ("hips", "head"):
        if (index := first(convention[role])) is not None:
            found[role] = index
    for side, mark in zip(SIDES, convention["sides"], strict=True):
        for role in LIMB_ROLES:
            if (index := first([c.format(s=mark) for c in convention[role]])) is not None:
                found[f"{side}_{role}"] = index
    taken = set(found.values())
    for chain in ("spine", "neck"):
        joints = [plain.index(c) for c in convention[chain] if c in plain and plain.index(c) not in taken]
        for k, joint in enumerate(sorted(joints, key=lambda j: _depth(parents, j))):
            found[f"{chain}_{k}"] = joint
    spine = [r for r in found if r.startswith("spine_")]
    if spine:
        # the chest is the top of the spine chain
        found["chest"] = found.pop(max(spine, key=lambda r: _depth(parents, found[r])))
    return found


def _depth(parents: Sequence[int], joint: int) -> int:
    depth = 0
    while parents[joint] >= 0:
        joint, depth = parents[joint], depth + 1
    return depth


def load_role_mapping(path: str | os.PathLike) -> dict[str, str]:
    """A JSON file {"left_upper_arm": "JointName", ...} that overrides the recognised roles."""
    try:
        mapping = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable JSON role mapping ({error}); "
                         'write {"left_upper_arm": "JointName", ...}') from None  # fmt: skip
    if not isinstance(mapping, dict) or not all(isinstance(v, str) for v in mapping.values()):
        raise InputError(f'{path}: a role mapping is one JSON object {{"left_upper_arm": "JointName", ...}}')
    return mapping


class Skeleton(eqx.Module, Remembering):
    """Joints in an order in which a parent stands before its children.

    `offsets` are joint positions in the parent's frame at bind [m]; that of the root is its bind position in the
    world. `rest_rotations` are the joint-to-parent rotations of the bind pose (the T-pose, for a clip that
    brought one). `end_offsets` are the tips (BVH End Sites) in the frame of `end_parents`. `channels` and
    `file_unit` [m] keep what the file said about each joint and its lengths, so that a round trip writes it again.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    parents: tuple[int, ...] = eqx.field(static=True)
    offsets: Float[AnyArray, "joints 3"]
    rest_rotations: Float[AnyArray, "joints 4"]
    roles: tuple[tuple[str, int], ...] = eqx.field(static=True)
    end_offsets: Float[AnyArray, "ends 3"]
    end_parents: tuple[int, ...] = eqx.field(static=True)
    channels: tuple[tuple[str, ...], ...] | None = eqx.field(static=True)
    file_unit: float = eqx.field(static=True)

    def __init__(
        self, names, parents, offsets, rest_rotations=None, *, roles=None, end_parents=(), end_offsets=None,
        channels=None, file_unit=1.0,
    ):  # fmt: skip
        """`roles` is a mapping role -> joint *name* that overrides what the names say."""
        self.names, self.parents = tuple(names), tuple(int(p) for p in parents)
        joints = len(self.names)
        if len(self.parents) != joints:
            raise InputError(f"{joints} joint names but {len(self.parents)} parents")
        if joints == 0 or self.parents[0] != -1 or any(not 0 <= p < i for i, p in enumerate(self.parents) if i):
            raise InputError("joints must form one tree with the root first and each parent before its children; "
                             f"got parents {self.parents}")  # fmt: skip
        duplicates = sorted({n for n in self.names if self.names.count(n) > 1})
        if duplicates:
            raise InputError(f"joint names must differ; these occur twice: {', '.join(duplicates)}")
        self.offsets = offsets
        identity = np.zeros((joints, 4)) + np.array([1.0, 0.0, 0.0, 0.0])
        self.rest_rotations = identity if rest_rotations is None else rest_rotations
        self.end_parents = tuple(int(p) for p in end_parents)
        self.end_offsets = np.zeros((0, 3)) if end_offsets is None else end_offsets
        self.channels, self.file_unit = channels, float(file_unit)
        self.roles = tuple(sorted(recognise_roles(self.names, self.parents, roles).items()))

    def __check_init__(self):
        for name, array, shape in (
            ("offsets", self.offsets, (len(self.names), 3)),
            ("rest_rotations", self.rest_rotations, (len(self.names), 4)),
            ("end_offsets", self.end_offsets, (len(self.end_parents), 3)),
        ):
            if hasattr(array, "shape") and array.shape != shape:
                raise InputError(f"skeleton {name} has shape {array.shape}, expected {shape}")

    @remembered
    def memo(self) -> dict:
        """What was computed once from this very skeleton on the host."""
        return {}

    @remembered
    def role_of_joint(self) -> dict[int, str]:
        """Joint index -> role, for the joints that have one."""
        return {joint: role for role, joint in self.roles}

    @remembered
    def _joint_of_role(self) -> dict[str, int]:
        return dict(self.roles)

    def find(self, role: str) -> int | None:
        """The joint of a role, or None."""
        return self._joint_of_role.get(role)

    def joint(self, role: str) -> int:
        """The joint of a role; an `InputError` names what is there when it is missing."""
        if (joint := self._joint_of_role.get(role)) is None:
            self.require(role)
        return joint  # type: ignore

    def require(self, *roles: str) -> None:
        """Raise one `InputError` that names every missing role together with what was found."""
        missing = [r for r in roles if r not in self._joint_of_role]
        if missing:
            found = ", ".join(f"{r}={self.names[j]}" for r, j in self.roles) or "none"
            raise InputError(
                f"no joint found for {', '.join(missing)}; found {found}; joints: {', '.join(self.names)}; "
                'name them in a JSON file {"' + missing[0] + '": "JointName", ...}: --roles FILE for a clip, '
                "--character-roles FILE for a character, roles= in Python"
            )

    def chain(self, kind: str) -> tuple[int, ...]:
        """The joints of the `spine` (up to and with the chest) or of the `neck`, from below."""
        joints = [j for r, j in self.roles if re.fullmatch(rf"{kind}_\d+", r) or (kind, r) == ("spine", "chest")]
        return tuple(sorted(joints))

    @remembered
    def levels(self) -> tuple[tuple[int, ...], ...]:
        """Joints by depth: level 0 is the root. Forward kinematics goes level by level."""
        depths = [_depth(self.parents, j) for j in range(len(self.names))]
        return tuple(tuple(j for j, d in enumerate(depths) if d == level) for level in range(max(depths) + 1))

    def children(self, joint: int) -> tuple[int, ...]:
        return tuple(j for j, p in enumerate(self.parents) if p == joint)

    def nearest_role(self, joint: int) -> str | None:
        """The role of the joint, or of its nearest ancestor that has one: twist bones, fingers and hip helpers
        belong to the limb that carries them."""
        while joint >= 0:
            if joint in self.role_of_joint:
                return self.role_of_joint[joint]
            joint = self.parents[joint]
        return None

    def is_same(self, other: "Skeleton") -> bool:
        """True where a motion of one can be played on the other bit for bit: same names, tree, offsets and rest."""
        return (
            self.names == other.names
            and self.parents == other.parents
            and np.array_equal(np.asarray(self.offsets)[1:], np.asarray(other.offsets)[1:])
            and np.array_equal(np.asarray(self.rest_rotations), np.asarray(other.rest_rotations))
        )

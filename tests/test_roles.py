"""Joint names to roles."""

import numpy as np
import pytest

import motionfit as mf
from motionfit._skeleton import LIMB_ROLES, SIDES

BIPED = ["Bip01", "Bip01 Pelvis", "Bip01 Spine", "Bip01 Spine1", "Bip01 Spine2", "Bip01 Neck", "Bip01 Head"]
for _s in "LR":
    BIPED += [
        f"Bip01 {_s} {n}"
        for n in ("Clavicle", "UpperArm", "Forearm", "Hand", "Finger0", "Thigh", "Calf", "Foot", "Toe0")
    ]
MIXAMO = ["Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"]
for _s in ("Left", "Right"):
    MIXAMO += [_s + n for n in ("Shoulder", "Arm", "ForeArm", "Hand", "HandIndex1", "UpLeg", "Leg", "Foot", "ToeBase")]
UNREAL = ["pelvis", "spine_01", "spine_02", "spine_03", "neck_01", "head"]
for _s in "lr":
    UNREAL += [f"{n}_{_s}" for n in ("clavicle", "upperarm", "lowerarm", "hand", "thigh", "calf", "foot", "ball")]


def _flat(names, **options):
    parents = [-1, *range(len(names) - 1)]
    return mf.Skeleton(names, parents, np.zeros((len(names), 3)), **options)


@pytest.mark.parametrize(
    "names",
    [BIPED, MIXAMO, [f"mixamorig:{n}" for n in MIXAMO], UNREAL],
    ids=["biped", "motionbuilder", "mixamo", "unreal"],
)
def test_conventions_give_every_role(names):
    skeleton = _flat(names)
    skeleton.require("hips", "chest", "head", *(f"{s}_{r}" for s in SIDES for r in LIMB_ROLES))
    assert len({j for _, j in skeleton.roles}) == len(skeleton.roles)
    assert len(skeleton.names) == len(names), "joints without a role are carried"


def test_helpers_belong_to_the_limb_that_carries_them():
    skeleton = _flat(["Hips", "LeftArm", "LeftArmTwist", "Bone42"])
    assert skeleton.nearest_role(3) == "left_upper_arm"


def test_a_mapping_overrides_and_unknown_names_are_listed():
    skeleton = _flat(["root", "belly", "armA"], roles={"hips": "root", "left_upper_arm": "armA"})
    assert dict(skeleton.roles) == {"hips": 0, "left_upper_arm": 2}
    with pytest.raises(mf.InputError, match="joints: root, belly"):
        _flat(["root", "belly"], roles={"hips": "nope"})
    with pytest.raises(mf.InputError, match="known roles: hips"):
        _flat(["root", "belly"], roles={"nose": "root"})


def test_what_is_missing_is_named_with_what_was_found():
    with pytest.raises(mf.InputError, match="no joint found for head; found hips=Hips; joints: Hips, Blob"):
        _flat(["Hips", "Blob"]).require("hips", "head")

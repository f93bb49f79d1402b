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


def rig(trunk: str, limbs: str, left: str, right: str) -> list[str]:
    """Names of a rig; `limbs` in the order of `LIMB_ROLES`, with * for the side."""
    return [*trunk.split(), *(n.replace("*", side) for side in (left, right) for n in limbs.split())]


RIGS = {
    "biped": BIPED, "motionbuilder": MIXAMO, "mixamo": [f"mixamorig:{n}" for n in MIXAMO], "unreal": UNREAL,
    "lafan1": rig("Hips Spine Spine1 Spine2 Neck Head",
                  "*Shoulder *Arm *ForeArm *Hand *UpLeg *Leg *Foot *Toe", "Left", "Right"),
    "rokoko newton": rig("Hips Spine1 Spine2 Spine3 Spine4 Neck Head",
                         "*Shoulder *Arm *ForeArm *Hand *Thigh *Shin *Foot *Toe", "Left", "Right"),
    "xsens": rig("Hips Chest Chest2 Chest3 Chest4 Neck Head",
                 "*Collar *Shoulder *Elbow *Wrist *Hip *Knee *Ankle *Toe", "Left", "Right"),
    "bandai-namco": rig("joint_Root Hips Spine Chest Neck Head",
                        "Shoulder_* UpperArm_* LowerArm_* Hand_* UpperLeg_* LowerLeg_* Foot_* Toes_*", "L", "R"),
    "smpl": rig("Pelvis Spine1 Spine2 Spine3 Neck Head",
                "*_Collar *_Shoulder *_Elbow *_Wrist *_Hip *_Knee *_Ankle *_Foot", "L", "R"),
    "smpl-x": rig("pelvis spine1 spine2 spine3 neck head",
                  "*_collar *_shoulder *_elbow *_wrist *_hip *_knee *_ankle *_foot", "left", "right"),
    "unity": rig("Hips Spine Chest UpperChest Neck Head",
                 "*Shoulder *UpperArm *LowerArm *Hand *UpperLeg *LowerLeg *Foot *Toes", "Left", "Right"),
    "vroid": rig("Root J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head",
                 "J_Bip_*_Shoulder J_Bip_*_UpperArm J_Bip_*_LowerArm J_Bip_*_Hand J_Bip_*_UpperLeg J_Bip_*_LowerLeg "
                 "J_Bip_*_Foot J_Bip_*_ToeBase", "L", "R"),
    "acclaim": rig("root lowerback upperback thorax lowerneck upperneck head",
                   "*clavicle *humerus *radius *wrist *femur *tibia *foot *toes", "l", "r"),
}  # fmt: skip


def _flat(names, **options):
    parents = [-1, *range(len(names) - 1)]
    return mf.Skeleton(names, parents, np.zeros((len(names), 3)), **options)


@pytest.mark.parametrize("names", RIGS.values(), ids=RIGS)
def test_conventions_give_every_role(names):
    skeleton = _flat(names)
    skeleton.require("hips", "chest", "head", *(f"{s}_{r}" for s in SIDES for r in LIMB_ROLES))
    assert len({j for _, j in skeleton.roles}) == len(skeleton.roles)
    assert len(skeleton.names) == len(names), "joints without a role are carried"


@pytest.mark.parametrize("name", [n for n in RIGS if n not in ("biped", "motionbuilder", "mixamo", "unreal")])
def test_each_limb_has_its_own_role(name):
    skeleton, names = _flat(RIGS[name]), RIGS[name]
    for side, some in zip(
        SIDES, (names[-2 * len(LIMB_ROLES) : -len(LIMB_ROLES)], names[-len(LIMB_ROLES) :]), strict=True
    ):
        assert [skeleton.names[skeleton.joint(f"{side}_{role}")] for role in LIMB_ROLES] == some


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

"""BVH in and out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import motionfit as mf
from motionfit._motion import joint_angles
from motionfit.io import describe
from motionfit.io.bvh import parse_bvh, read_bvh, write_bvh
from tests.helpers import matrices

ANGLE = np.deg2rad(1e-4)

SMALL = """HIERARCHY\r
ROOT Hips\r
{\r
\tOFFSET 0 0 0\r
\tCHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation\r
\tJOINT Left Leg.001 {\r
\t\tOFFSET 1.0E-1 -4e-1 0\r
\t\tCHANNELS 2 Xrotation Zrotation\r
\t\tEnd Site\r
\t\t{\r
\t\t\tOFFSET 0 -0.4 0\r
\t\t}\r
\t}\r
}\r
MOTION\r
Frames:\t2\r
Frame Time: .0083333\r
0 1 2 10 20 30 40 50\r
0 1 2.5 1e1 -2E+1 30 -40 5.0\r
"""


def test_numbers_tabs_line_ends_and_odd_channels(tmp_path):
    (tmp_path / "a.bvh").write_bytes(SMALL.encode())
    motion = read_bvh(tmp_path / "a.bvh", unit=1.0)
    assert motion.skeleton.names == ("Hips", "Left Leg.001")
    assert float(motion.dt) == 0.0083333
    from scipy.spatial.transform import Rotation

    expected = Rotation.from_euler("ZYX", [[10, 20, 30]], degrees=True)
    assert (Rotation.from_quat(motion.rotations[:1, 0], scalar_first=True).inv() * expected).magnitude()[0] < 1e-12
    expected = Rotation.from_euler("XZ", [[-40, 5]], degrees=True)
    assert (Rotation.from_quat(motion.rotations[1:, 1], scalar_first=True).inv() * expected).magnitude()[0] < 1e-12
    np.testing.assert_allclose(motion.root, [[0, 1, 2], [0, 1, 2.5]])


@given(st.integers(0, 2**31), st.permutations("XYZ"), st.integers(1, 9), st.sampled_from([0.01, 1 / 120, 0.0333333]))
def test_round_trip_of_random_skeletons(tmp_path_factory, seed, order, joints, frame_time):
    from tests.helpers import random_motion

    motion = random_motion(seed, joints, 4)
    channels = tuple(
        (("Xposition", "Yposition", "Zposition") if j == 0 else ()) + tuple(f"{a}rotation" for a in order)
        for j in range(joints)
    )
    skeleton = mf.Skeleton(motion.skeleton.names, motion.skeleton.parents, motion.skeleton.offsets, channels=channels)
    motion = mf.Motion(skeleton, motion.root, motion.rotations, np.asarray(frame_time))
    path = tmp_path_factory.mktemp("bvh") / "x.bvh"
    write_bvh(path, motion)
    again = read_bvh(path, unit=1.0, up="y", rest_frame="none")
    assert float(again.dt) == frame_time
    order_of = [again.skeleton.names.index(n) for n in skeleton.names]
    assert again.skeleton.channels is not None
    assert [again.skeleton.channels[i] for i in order_of] == list(channels)
    back = mf.Motion(skeleton, again.root, again.rotations[:, order_of], again.dt)
    assert joint_angles(back, motion).max() < ANGLE
    np.testing.assert_allclose(again.root, motion.root, atol=1e-6)


def test_moving_joint_positions_are_carried(tmp_path):
    text = SMALL.replace("CHANNELS 2 Xrotation Zrotation", "CHANNELS 4 Xposition Yposition Xrotation Zrotation")
    text = text.replace("30 40 50\r", "30 0.1 -0.4 40 50\r").replace("30 -40 5.0\r", "30 0.3 -0.4 -40 5.0\r")
    (tmp_path / "a.bvh").write_bytes(text.encode())
    motion = read_bvh(tmp_path / "a.bvh", unit=1.0)
    assert motion.translations is not None
    np.testing.assert_allclose(motion.translations[:, 1], [[0.1, -0.4, 0], [0.3, -0.4, 0]])


def test_z_up_files_are_turned(tmp_path):
    (tmp_path / "a.bvh").write_bytes(SMALL.encode())
    motion = read_bvh(tmp_path / "a.bvh", unit=1.0, up="z")
    np.testing.assert_allclose(motion.root[0], [0, 2, -1], atol=1e-12)


def test_every_real_file_reads_and_round_trips(shared_data, tmp_path):
    files = sorted([*(shared_data / "bvh").glob("*.bvh"), *(shared_data / "locomotion").glob("walk_*.bvh")])
    for path in files:
        motion, file = read_bvh(path), parse_bvh(path)
        assert motion.frame_count == len(file.values) - 1, f"{path.name}: the T-pose is not motion"
        assert motion.skeleton.file_unit == pytest.approx(0.0564444)
        motion.skeleton.require("hips", "chest", "head", "left_hand", "right_foot", "left_clavicle", "right_toe")
    for path in files[:4]:
        motion = read_bvh(path)
        write_bvh(tmp_path / "x.bvh", motion)
        again, a, b = read_bvh(tmp_path / "x.bvh"), parse_bvh(path), parse_bvh(tmp_path / "x.bvh")
        assert (a.names, a.parents, a.channels, a.frame_time) == (b.names, b.parents, b.channels, b.frame_time)
        np.testing.assert_allclose(a.offsets, b.offsets, atol=1e-5)
        assert joint_angles(motion, again).max() < ANGLE
        from motionfit._motion import host_kinematics

        np.testing.assert_allclose(host_kinematics(motion)[0][5], matrices(motion, 5)[:, :3, 3], atol=1e-10)


def test_other_rigs_are_recognised(shared_data):
    units = {"cmu_daz": 0.01, "cmu_max": 0.0564444, "reactidle": 1.0, "rokoko": 0.01}
    for path in sorted((shared_data / "bvh_other").glob("*.bvh")):
        found = describe(path)
        unit = next(u for k, u in units.items() if path.name.startswith(k))
        assert found["unit_m"] == pytest.approx(unit), path.name
        assert {"hips", "left_thigh", "right_forearm"} <= set(found["roles"]), path.name

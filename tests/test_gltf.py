"""glTF in and out, through the Khronos validator where node is there."""

import json
import pathlib
import shutil
import subprocess
import tempfile

import numpy as np
import pytest

import motionfit as mf
from motionfit import samples
from motionfit._motion import joint_angles, rest_motion
from motionfit.io.gltf import _sample

FIGURES = 1e-6  # float32 in the file


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    body = mf.load_character("builtin:average")
    motion = samples.walk(cycles=1)
    path = tmp_path_factory.mktemp("gltf") / "walk.glb"
    mf.save(path, motion, body)
    mf.save(path.with_suffix(".gltf"), motion, body)
    return path, motion, body


@pytest.mark.parametrize("ending", [".glb", ".gltf"])
def test_round_trip(written, ending):
    path, motion, body = written
    character, again = mf.load_character(path.with_suffix(ending)), mf.load_motion(path.with_suffix(ending))
    assert character.skeleton.names == body.skeleton.names and character.skeleton.parents == body.skeleton.parents
    np.testing.assert_allclose(character.skin.vertices_bind, body.skin.vertices_bind, atol=FIGURES)
    assert np.array_equal(character.skin.faces, body.skin.faces)
    assert len(character.skeleton.end_parents) == len(body.skeleton.end_parents)
    assert again.frame_count == motion.frame_count and again.frame_rate == pytest.approx(60.0)
    assert joint_angles(mf.Motion(motion.skeleton, again.root, again.rotations, again.dt), motion).max() < 1e-3
    np.testing.assert_allclose(again.root, motion.root, atol=1e-5)


def test_skinning_at_bind_gives_the_mesh(written):
    character = mf.load_character(written[0])
    posed, _ = mf.skin(character.skin, mf.forward_kinematics(character.skeleton, rest_motion(character.skeleton)))
    np.testing.assert_allclose(posed[0], character.skin.vertices_bind, atol=FIGURES)


def test_interpolation_modes():
    keys, times = np.array([0.0, 1.0, 2.0]), np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    values = np.array([[0.0], [1.0], [0.0]])
    np.testing.assert_allclose(_sample((keys, values, "LINEAR"), times, np.zeros(1))[:, 0], [0, 0.5, 1, 0.5, 0])
    np.testing.assert_allclose(_sample((keys, values, "STEP"), times, np.zeros(1))[:, 0], [0, 0, 1, 1, 0])
    cubic = np.array([[0.0], [0.0], [2.0], [0.0], [1.0], [-1.0], [3.0], [0.0], [0.0]])
    # the glTF Hermite formula at the middle: (p0 + p1) / 2 + (m0 - m1) / 8
    expected = [0.0, 0.5 + (2 - 0) / 8, 1.0, 0.5 + (-1 - 3) / 8, 0.0]
    np.testing.assert_allclose(_sample((keys, cubic, "CUBICSPLINE"), times, np.zeros(1))[:, 0], expected, atol=1e-12)


def test_khronos_validator_finds_nothing(written):
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node and npm are not installed: the Khronos validator cannot run")
    folder = pathlib.Path(tempfile.gettempdir()) / "motionfit-gltf-validator"
    folder.mkdir(exist_ok=True)
    installed = subprocess.run(["npm", "install", "--no-audit", "--no-fund", "gltf-validator"], cwd=folder,
                               capture_output=True, text=True, timeout=300)  # fmt: skip
    if installed.returncode:
        pytest.skip("npm cannot install gltf-validator here")
    script = ("const v=require('gltf-validator'),fs=require('fs');v.validateBytes(new Uint8Array(fs.readFileSync("
              "process.argv[1]))).then(r=>console.log(JSON.stringify(r.issues)))")  # fmt: skip
    for path in (written[0], written[0].with_suffix(".gltf")):
        run = subprocess.run(["node", "-e", script, str(path)], cwd=folder, capture_output=True, text=True, timeout=120)
        issues = json.loads(run.stdout)
        assert issues["numErrors"] == 0 and issues["numWarnings"] == 0, issues["messages"][:5]


def test_real_characters(shared_data):
    for path in sorted((shared_data / "characters").glob("*.glb")):
        body = mf.load_character(path)
        assert (len(body.skin.vertices_bind), len(body.skeleton.names)) == (13348, 31)
        assert body.skin.vertices_bind[:, 1].min() == pytest.approx(0.0, abs=2e-3)
        body.skeleton.require("hips", "chest", "head", "left_hand", "right_foot")


def test_z_up_root_comes_out_upright(shared_data):
    body = mf.load_character(shared_data / "characters_thirdparty" / "CesiumMan.glb")
    size = np.ptp(body.skin.vertices_bind, axis=0)
    assert 1.4 < size[1] < 1.8 and size[1] == size.max()
    assert mf.load_motion(shared_data / "characters_thirdparty" / "CesiumMan.glb").frame_count > 10

"""Broken inputs: each gets one line on stderr that says what and where, exit status 2, and no output file."""

import dataclasses
import json
import pathlib
import sys

import numpy as np
import pytest

import motionfit as mf
from motionfit import samples, view
from motionfit._files import whole
from motionfit.cli import main

BVH = """HIERARCHY
ROOT Hips
{
 OFFSET 0 0 0
 CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
 JOINT Spine
 {
  OFFSET 0 1 0
  CHANNELS 3 Zrotation Yrotation Xrotation
  End Site
  {
   OFFSET 0 1 0
  }
 }
}
MOTION
Frames: 2
Frame Time: 0.01
0 0 0 0 0 0 0 0 0
0 0 0 0 0 0 0 0 0
"""

TEXTS = {
    "cut in the hierarchy": (BVH[:120], "cut off"),
    "cut in the frames": (BVH.rsplit("\n", 2)[0], "2 frames announced, 1 found"),
    "a value missing": (BVH[:-4] + "\n", "frame 1 has"),
    "more rows than announced": (BVH + "0 0 0 0 0 0 0 0 0\n", "more rows"),
    "not a number": (BVH.replace("\n0 0 0 0 0 0 0 0 0\n", "\n0 0 nan 0 0 0 0 0 0\n", 1), "not finite in column 3"),
    "a word for a number": (BVH.replace("\n0 0 0 0 0 0 0 0 0\n", "\n0 0 x 0 0 0 0 0 0\n", 1), "'x'"),
    "frame time zero": (BVH.replace("0.01", "0"), "above 0"),
    "no frames": (BVH.replace("Frames: 2", "Frames: 0"), "at least one"),
    "no motion": (BVH.split("MOTION")[0], "without MOTION"),
    "unbalanced braces": (BVH.replace(" }\n}\nMOTION", "}\nMOTION"), "braces are still open"),
    "unknown channel": (
        BVH.replace("Zrotation Yrotation Xrotation\n  End", "Wrotation Yrotation Xrotation\n  End"),
        "Wrotation",
    ),
    "two joints of one name": (BVH.replace("JOINT Spine", "JOINT Hips"), "occur twice"),
    "empty": ("", "empty"),
    "another text": ("hello world\n", "no BVH keyword"),
}


def _run(monkeypatch, capsys, *arguments) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["motionfit", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_:
        main()
    code = exit_.value.code
    assert isinstance(code, int)
    return code, capsys.readouterr().err


def _refused(monkeypatch, capsys, tmp_path, clip, body, fact, *more):
    out = tmp_path / "out.glb"
    code, said = _run(monkeypatch, capsys, "adapt", clip, body, "-o", out, *more)
    assert code == 2
    assert said.count("\n") == 1 and said.startswith("motionfit: "), said
    assert fact in said, said
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize("case", TEXTS)
def test_broken_bvh(case, monkeypatch, capsys, tmp_path):
    text, fact = TEXTS[case]
    (tmp_path / "clip.bvh").write_text(text)
    _refused(monkeypatch, capsys, tmp_path, tmp_path / "clip.bvh", "builtin:average", fact)


def test_binary_noise(monkeypatch, capsys, tmp_path):
    noise = np.random.default_rng(0).bytes(5000)
    for name in ("clip.bvh", "clip.glb", "clip.npz"):
        (tmp_path / name).write_bytes(noise)
        _refused(monkeypatch, capsys, tmp_path, tmp_path / name, "builtin:average", name)


def test_places_that_hold_no_file(monkeypatch, capsys, tmp_path):
    (tmp_path / "walk.bvh").mkdir()
    _refused(monkeypatch, capsys, tmp_path, tmp_path / "walk.bvh", "builtin:average", "folder")
    _refused(monkeypatch, capsys, tmp_path, tmp_path / "wolk.bvh", "builtin:average", "did you mean walk.bvh")
    _refused(monkeypatch, capsys, tmp_path, tmp_path / "walk.fbx", "builtin:average", "not read yet")
    _refused(monkeypatch, capsys, tmp_path, "builtin:dance", "builtin:average", "builtin:walk")
    _refused(monkeypatch, capsys, tmp_path, "builtin:walk", "builtin:giant", "average, slim, heavy, child")


def test_no_permission(monkeypatch, capsys, tmp_path):
    (tmp_path / "clip.bvh").write_text(BVH)

    def refuse(self):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(pathlib.Path, "read_bytes", refuse)
    _refused(monkeypatch, capsys, tmp_path, tmp_path / "clip.bvh", "builtin:average", "permission")


def test_options_say_what_is_allowed(monkeypatch, capsys, tmp_path):
    for more, fact in (
        (("--blocks", "arms,nose"), "blocks: arms, legs, forearm"), (("--objective", "magic"), "vertex, capsule, joint"),
        (("--girth", "arms"), "arms=1.3"), (("--girth", "nose=2"), "parts: arms, legs, trunk"),
        (("--girth", "arms=99"), "0.1 to 5"), (("--fps", "0"), "frame rate"), (("--start", "90"), "start 90"),
    ):  # fmt: skip
        _refused(monkeypatch, capsys, tmp_path, "builtin:walk", "builtin:average", fact, *more)
    code, said = _run(monkeypatch, capsys, "adapt", "builtin:walk", "builtin:average", "-o", tmp_path / "no" / "x.glb")
    assert code == 2 and "mkdir" in said
    code, said = _run(monkeypatch, capsys, "adapt", "builtin:walk", "builtin:average", "-o", tmp_path / "x.doc")
    assert code == 2 and ".glb" in said


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("good") / "body.gltf"
    mf.save(path, samples.walk(cycles=1), mf.load_character("builtin:child"))
    return json.loads(path.read_text())


def _accessor(document, data, index):
    """Write over an accessor's bytes inside the data URI."""
    import base64

    view = document["bufferViews"][document["accessors"][index]["bufferView"]]
    raw = bytearray(base64.b64decode(document["buffers"][0]["uri"].split(",")[1]))
    raw[view["byteOffset"] : view["byteOffset"] + len(data)] = data
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(bytes(raw)).decode()


def _no_skin(d):
    del d["skins"], d["nodes"][-1]["skin"]


def _no_mesh(d):
    del d["nodes"][-1]["skin"]


def _loop(d):
    d["nodes"][3].setdefault("children", []).append(0)


def _zero_weight(d):
    _accessor(d, np.zeros(4, np.float32).tobytes(), d["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"])


def _nan_position(d):
    _accessor(d, np.full(3, np.nan, np.float32).tobytes(), d["meshes"][0]["primitives"][0]["attributes"]["POSITION"])


def _joint_beyond(d):
    _accessor(d, bytes([200] * 4), d["meshes"][0]["primitives"][0]["attributes"]["JOINTS_0"])


def _accessor_beyond(d):
    d["accessors"][0]["count"] = 10**7


def _buffer_missing(d):
    d["buffers"][0]["uri"] = "gone.bin"


def _bind_count(d):
    d["accessors"][d["skins"][0]["inverseBindMatrices"]]["count"] = 5


def _no_weights(d):
    del d["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"]


@pytest.mark.parametrize(
    ("spoil", "fact"),
    [
        (_no_skin, "no skin"), (_no_mesh, "moves no mesh"), (_loop, "loop"), (_zero_weight, "no skin weight"),
        (_nan_position, "not finite"), (_joint_beyond, "names joint 200"), (_accessor_beyond, "damaged"),
        (_buffer_missing, "gone.bin"), (_bind_count, "inverse bind matrices"), (_no_weights, "skin weights"),
    ],
)  # fmt: skip
def test_broken_gltf(good, spoil, fact, monkeypatch, capsys, tmp_path):
    document = json.loads(json.dumps(good))
    spoil(document)
    (tmp_path / "body.gltf").write_text(json.dumps(document))
    _refused(monkeypatch, capsys, tmp_path, "builtin:walk", tmp_path / "body.gltf", fact)


def test_truncated_glb(monkeypatch, capsys, tmp_path):
    mf.save(tmp_path / "body.glb", samples.walk(cycles=1), mf.load_character("builtin:child"))
    data = (tmp_path / "body.glb").read_bytes()
    (tmp_path / "body.glb").write_bytes(data[: len(data) // 2])
    _refused(monkeypatch, capsys, tmp_path, "builtin:walk", tmp_path / "body.glb", "cut off")


def test_a_skeleton_without_the_roles_is_told_what_was_found(monkeypatch, capsys, tmp_path):
    (tmp_path / "clip.bvh").write_text(BVH)
    _refused(monkeypatch, capsys, tmp_path, tmp_path / "clip.bvh", "builtin:average", "found chest=Spine, hips=Hips")


def test_a_character_of_unknown_joints_is_named_and_its_roles_can_be_given(monkeypatch, capsys, tmp_path):
    from motionfit._skeleton import Skeleton

    body, walk = mf.load_character("builtin:child"), samples.walk(cycles=1)[:8]
    known = body.skeleton
    names = tuple(f"bone_{k}" for k in range(len(known.names)))
    nameless = Skeleton(names, known.parents, known.offsets, known.rest_rotations)
    clip = mf.onto(walk, known)
    mf.save(tmp_path / "body.glb", dataclasses.replace(clip, skeleton=nameless), mf.Character(nameless, body.skin, "x"))
    fact = "body.glb: no joint found for hips"
    _refused(monkeypatch, capsys, tmp_path, "builtin:walk", tmp_path / "body.glb", fact)
    _refused(monkeypatch, capsys, tmp_path, "builtin:walk", tmp_path / "body.glb", "--character-roles FILE")
    (tmp_path / "roles.json").write_text(json.dumps({role: names[joint] for role, joint in known.roles}))
    mf.save(tmp_path / "clip.bvh", walk)
    code, said = _run(monkeypatch, capsys, "metrics", tmp_path / "clip.bvh", tmp_path / "body.glb",
                      "--character-roles", tmp_path / "roles.json", "--json", tmp_path / "m.json")  # fmt: skip
    assert code == 0, said
    measured = json.loads((tmp_path / "m.json").read_text())
    expected = mf.metrics.skin_depths(body, clip, step=4).depth.max()
    assert measured["penetration"]["skin"]["excess_max_m"] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("name", ["clip.bvh", "clip.glb", "clip.npz", "correction.npz", "plants.csv", "look.png"])
def test_what_cannot_be_written_whole_leaves_the_old_file_and_nothing_beside_it(name, monkeypatch, tmp_path):
    clip, body = samples.walk(cycles=1), mf.load_character("builtin:average")
    found = mf.remove_footskate(clip, body)
    save = {
        "correction.npz": mf.Correction((), ()).save,
        "plants.csv": found.plants.save,
        "look.png": lambda path: view.footprints_picture(path, found),
    }.get(name, lambda path: mf.save(path, clip, body))
    old = tmp_path / name
    old.write_bytes(b"what was there before")

    def full(self, target):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch, pytest.raises(mf.InputError, match=f"{name}: cannot be written .No space"):
        patch.setattr(pathlib.Path, "replace", full)
        save(old)
    assert old.read_bytes() == b"what was there before"
    assert [file.name for file in tmp_path.iterdir()] == [name]
    save(old)
    assert old.read_bytes() != b"what was there before"
    assert [file.name for file in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    ("error", "told"), [(OSError(28, "No space left on device"), mf.InputError), (KeyError("x"), KeyError)]
)
def test_a_file_that_breaks_off_halfway_is_not_there(error, told, tmp_path):
    with pytest.raises(told), whole(tmp_path / "clip.bvh") as partial:
        partial.write_bytes(b"half of it")
        raise error
    assert list(tmp_path.iterdir()) == []

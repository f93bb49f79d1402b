"""The built-in people against the anthropometry that they claim."""

import numpy as np
import pytest
import trimesh

import motionfit as mf
from motionfit.shape import bodies
from motionfit.shape._body_measures import BUILTIN, SHAPES, joint_places

VOLUME = {"average": (62, 84), "slim": (50, 72), "heavy": (100, 135), "child": (20, 31)}  # litres
GIRTH = 0.09  # a smooth surface between few landmarks is not a tape measure


@pytest.mark.parametrize("name", BUILTIN)
def test_closed_human_sized_and_standing_flat(name):
    body, shape = mf.load_character(f"builtin:{name}"), SHAPES[name]
    vertices = np.asarray(body.skin.vertices_bind)
    mesh = trimesh.Trimesh(vertices, body.skin.faces, process=False)
    assert mesh.is_watertight and mesh.euler_number == 2 and mesh.body_count == 1
    low, high = VOLUME[name]
    assert low < 1000 * mesh.volume < high
    assert np.ptp(vertices[:, 1]) == pytest.approx(shape.stature, abs=0.01)
    assert 4000 <= len(vertices) <= 10000
    for side in (1, -1):
        assert ((vertices[:, 1] < 0.002) & (side * vertices[:, 0] > 0)).sum() >= 15
    assert vertices[:, 1].min() >= -1e-9
    np.testing.assert_allclose(body.skin.weights.sum(1), 1.0, atol=1e-12)
    body.skeleton.require("hips", "chest", "head", "left_toe", "right_clavicle", "left_hand")
    side = mesh.triangles_center[:, 0]
    left, right = mesh.area_faces[side > 0].sum(), mesh.area_faces[side < 0].sum()
    assert left == pytest.approx(right, rel=0.01)


@pytest.mark.parametrize("name", BUILTIN)
def test_girths(name):
    body, shape = mf.load_character(f"builtin:{name}"), SHAPES[name]
    at = {k: v for k, (_, v) in joint_places(shape).items()}
    mesh = trimesh.Trimesh(body.skin.vertices_bind, body.skin.faces, process=False)

    def girth(origin, normal):
        section = mesh.section(plane_origin=origin, plane_normal=normal)
        assert section is not None
        nearest = min(section.discrete, key=lambda loop: np.linalg.norm(loop.mean(0) - origin))
        return np.linalg.norm(np.diff(nearest, axis=0), axis=1).sum()

    def along(a, b, t):
        return at[a] + t * (at[b] - at[a]), at[b] - at[a]

    up = np.array([0.0, 1.0, 0.0])
    hip = at["LeftUpLeg"][1]
    measured = {
        "waist": girth(np.array([0, hip + 0.105 * shape.stature, 0]), up),
        "calf": girth(*along("LeftLeg", "LeftFoot", 0.3)),
        "upper_arm": girth(*along("LeftArm", "LeftForeArm", 0.55)),
        "forearm": girth(*along("LeftForeArm", "LeftHand", 0.2)),
        "neck": girth(at["Neck1"] + [0, 0.01 * shape.stature, 0], up),
    }
    for part, value in measured.items():
        assert value == pytest.approx(getattr(shape, part), rel=GIRTH), part


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(mf.InputError, match="average, slim, heavy, child"):
        mf.load_character("builtin:giant")


def test_cache_gives_the_same_arrays_and_survives_damage(tmp_path, monkeypatch):
    monkeypatch.setenv("MOTIONFIT_CACHE", str(tmp_path))
    made = bodies.builtin_body("child")
    (file,) = tmp_path.glob("body-*.npz")
    read = bodies.builtin_body("child")
    assert np.array_equal(made.skin.vertices_bind, read.skin.vertices_bind)
    file.write_bytes(b"damaged")
    again = bodies.builtin_body("child")
    assert np.array_equal(made.skin.vertices_bind, again.skin.vertices_bind)

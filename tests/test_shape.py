"""Volumes against closed forms, distances against dense sampling, girth growth."""

import dataclasses

import equinox as eqx
import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import motionfit as mf
from motionfit import samples
from motionfit._character import PARTS
from motionfit._motion import bind_pose
from motionfit.metrics import posed_vertices, skin_gaps
from motionfit.shape import grow, parse_girth
from motionfit.shape.distance import capsule_depth, closest_on_lines, cylinder_depth, segment_distance
from motionfit.shape.field import depths, fit_field, standing, standing_vertices
from motionfit.shape.pairs import Pair
from motionfit.shape.probes import make_probes
from motionfit.shape.surface import inside_depths, may_be_inside, part_surface, surface_gaps
from motionfit.shape.volumes import fit_volumes
from tests.helpers import central_difference


@given(st.integers(0, 2**31), st.booleans())
def test_segment_distance_is_the_least_over_dense_samples(seed, parallel):
    rng = np.random.default_rng(seed)
    p0, p1, q0, q1 = rng.normal(size=(4, 3))
    if parallel:
        q1 = q0 + rng.normal() * (p1 - p0)
    distance, s, t = segment_distance(*(jnp.asarray(x) for x in (p0, p1, q0, q1)))
    grid = np.linspace(0, 1, 201)
    gaps = (p0 + grid[:, None] * (p1 - p0))[:, None] - (q0 + grid[:, None] * (q1 - q0))[None]
    assert float(distance) <= np.linalg.norm(gaps, axis=-1).min() + 1e-9
    reached = p0 + float(s) * (p1 - p0) - q0 - float(t) * (q1 - q0)
    assert 0 <= s <= 1 and 0 <= t <= 1 and np.linalg.norm(reached) == pytest.approx(float(distance), abs=1e-9)


def test_lines_follow_the_corrected_formula():
    """The connecting vector is perpendicular to both lines; with the thesis's printed t it is not."""
    rng = np.random.default_rng(0)
    p0, u, q0, v = (jnp.asarray(x) for x in rng.normal(size=(4, 3)))
    s, t = closest_on_lines(p0, u, q0, v)
    w = p0 + s * u - q0 - t * v
    assert abs(w @ u) < 1e-10 and abs(w @ v) < 1e-10


def test_cylinder_and_capsule_depths_in_closed_form():
    x, z = jnp.array([1.0, 0, 0]), jnp.array([0, 0, 1.0])
    crossed = (-x, x, jnp.asarray(0.3), -z + jnp.array([0, 0.4, 0]), z + jnp.array([0, 0.4, 0]), jnp.asarray(0.2))
    for rule in (capsule_depth, cylinder_depth):
        assert float(rule(*crossed)) == pytest.approx(0.1)
    # end to end: the capsule's half sphere reaches 0.2 further than the flat end
    ends = (-x, x, jnp.asarray(0.2), x * 1.1 - z, x * 1.1 + z, jnp.asarray(0.05))
    assert float(capsule_depth(*ends)) == pytest.approx(0.15)
    assert float(cylinder_depth(*ends)) == pytest.approx(-0.05)


def _tube(radius: float, length: float, sections: int = 64) -> mf.Character:
    """A cylinder along y bound to a forearm on a person's arm joint names."""
    mesh = trimesh.creation.cylinder(radius, length, sections=sections)
    mesh = mesh.subdivide_to_size(0.05)
    assert isinstance(mesh, trimesh.Trimesh)
    side = np.abs(mesh.face_normals[:, 2]) < 0.5
    mesh.update_faces(side)
    mesh.remove_unreferenced_vertices()
    vertices = np.asarray(mesh.vertices)[:, [1, 2, 0]] + [0, 0, 0]
    skeleton = mf.Skeleton(["LeftForeArm", "LeftHand"], [-1, 0], np.array([[0, -length / 2, 0], [0, length, 0.0]]))
    joints = np.zeros((len(vertices), 1), np.int32)
    return mf.Character(skeleton, mf.Skin(vertices, np.asarray(mesh.faces), joints, np.ones((len(vertices), 1))))


def test_a_cylinder_is_found_as_one():
    """Points on the side have variance r^2/2 across: the erratum of thesis (4.1)."""
    body = _tube(0.06, 0.5)
    volumes = fit_volumes(body, "cylinder")
    assert volumes.radii[volumes.index("left_forearm")] == pytest.approx(0.06, rel=0.01)
    capsule = fit_volumes(body, "capsule")
    k = capsule.index("left_forearm")
    assert np.linalg.norm(capsule.end[k] - capsule.start[k]) == pytest.approx(0.5 - 0.12, rel=0.02)


def test_a_field_tells_the_depth_below_the_skin(heavy):
    """Against exact distances to the part's own surface in the tabulated pose, at random points in and around it."""
    posed = standing_vertices(heavy)
    still = standing(heavy.skeleton)
    kin = mf.forward_kinematics(heavy.skeleton, still)
    rng = np.random.default_rng(0)
    for part in ("torso", "left_thigh", "right_calf"):
        field, surface = fit_field(heavy, part), part_surface(heavy, part)
        vertices = posed[surface.used]
        corners = vertices[surface.triangles[rng.integers(0, len(surface.triangles), 400)]].mean(axis=1)
        points = corners + rng.normal(size=(400, 3)) * 0.02
        exact = inside_depths(points, vertices, surface.triangles)
        told = np.asarray(field.depth(kin, points.T[None]))[0]
        inside = exact > 0.004
        assert np.median(np.abs(told[inside] - exact[inside])) < 0.0015, part
        assert np.mean(told[exact == 0] < 0.004) > 0.95, part


def test_a_point_over_the_middle_of_a_triangle_may_be_nearer_than_one_at_a_corner():
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    points = np.array([[0.5, 0.5, 0.6], [0.2, 0.1, 0.55]])
    assert abs(surface_gaps([points], np.asarray(box.vertices), np.asarray(box.faces, np.int64))[0].gap - 0.05) < 1e-9


@given(st.integers(0, 2**31), st.sampled_from(["torso", "left_upper_arm", "right_forearm", "left_thigh", "right_calf"]))
def test_inside_depths_are_those_of_all_triangles(heavy, seed, part):
    """What spares libigl its trees changes nothing: in random poses, for points on, around and far from a part."""
    rng, skeleton = np.random.default_rng(seed), heavy.skeleton
    pose = standing(skeleton)
    turns = Rotation.from_rotvec(rng.normal(size=(len(skeleton.names), 3)) * 0.3).as_quat(scalar_first=True)
    pose = dataclasses.replace(pose, rotations=np.asarray(mf.rotation.multiply(pose.rotations[0], turns))[None])
    posed = posed_vertices(heavy, pose)[0].astype(float)
    surface = part_surface(heavy, part)
    vertices = posed[surface.used]
    points = vertices[rng.integers(0, len(vertices), 200)] + rng.normal(size=(200, 3)) * rng.choice([0.01, 0.05, 0.3])
    points = np.concatenate([points, posed[rng.integers(0, len(posed), 200)]])
    inside = np.asarray(igl.fast_winding_number(vertices, surface.triangles, points)) > 0.5
    distance = np.sqrt(np.asarray(igl.point_mesh_squared_distance(points, vertices, surface.triangles)[0]))
    wanted = np.where(inside, distance, 0.0)
    assert np.abs(inside_depths(points, vertices, surface.triangles) - wanted).max() < 1e-6
    for some, gap in ((~inside, distance[~inside].min(initial=np.inf)), (inside, -distance[inside].max(initial=0.0))):
        if some.any():
            assert abs(surface_gaps([points[some]], vertices, surface.triangles)[0].gap - gap) < 1e-6


def test_gaps_of_a_motion_are_those_of_each_pose_and_pair(heavy):
    """Pairs of one surface share its tree, and what was measured before is kept: by pose, and only what was asked for."""
    motion = mf.onto(samples.walk(cycles=1), heavy.skeleton)[:60:20]
    pairs = tuple(
        Pair(*names, "") for names in (("left_hand", "torso"), ("right_hand", "torso"), ("left_hand", "head"))
    )
    wanted = np.array([[True, True, False], [True, False, True], [False, False, False]])
    some, everywhere = skin_gaps(heavy, motion, pairs, wanted), skin_gaps(heavy, motion, pairs)
    assert np.array_equal(np.isnan(some), ~wanted) and np.array_equal(some[wanted], everywhere[wanted])
    for t, posed in enumerate(posed_vertices(heavy, motion).astype(float)):
        for k, pair in enumerate(pairs):
            surface = part_surface(heavy, pair.second)
            points = posed[part_surface(heavy, pair.first).vertices]
            alone = surface_gaps([points], posed[surface.used], surface.triangles)
            assert everywhere[t, k] == pytest.approx(alone[0].gap, abs=1e-6)


def test_a_field_moves_with_its_part(heavy, rng):
    """Turning and moving the whole body moves the depths along: they are the same at the moved points."""
    field, still = fit_field(heavy, "torso"), standing(heavy.skeleton)
    points = standing_vertices(heavy)[rng.integers(0, len(heavy.skin.vertices_bind), 50)]
    turn, shift = Rotation.from_euler("yx", [70, 20], degrees=True), np.array([0.5, 0.2, -1.0])
    rotations = np.array(still.rotations)
    rotations[0, 0] = (turn * Rotation.from_quat(rotations[0, 0], scalar_first=True)).as_quat(scalar_first=True)
    moved = mf.Motion(heavy.skeleton, turn.apply(np.asarray(still.root)) + shift, rotations, still.dt)
    before, after = (
        field.depth(mf.forward_kinematics(heavy.skeleton, m), p.T[None])
        for m, p in ((still, points), (moved, turn.apply(points) + shift))
    )
    np.testing.assert_allclose(before, after, atol=1e-9)


def test_fields_side_by_side_are_those_alone(heavy, rng):
    """A trunk on several joints and limbs on one, on grids of two sizes, each with its own points."""
    walk = mf.onto(samples.walk(cycles=1), heavy.skeleton)[::20]
    kin = mf.forward_kinematics(heavy.skeleton, walk)
    fields = [fit_field(heavy, part) for part in ("left_thigh", "torso", "right_calf")]
    posed = mf.metrics.posed_vertices(heavy, walk)
    points = [jnp.asarray(posed[:, rng.integers(0, posed.shape[1], n)].swapaxes(1, 2)) for n in (7, 5, 9)]
    alone = jnp.concatenate([f.depth(kin, p) for f, p in zip(fields, points, strict=True)], axis=1)
    np.testing.assert_allclose(depths(kin, fields, points), alone, atol=1e-12)


def test_lookups_have_the_gradient_that_differences_show(heavy, rng):
    field = fit_field(heavy, "left_thigh")
    size = np.array(field.coefficients.shape)
    points = np.asarray(field.origin) + rng.uniform(0.5, size - 1.5, size=(40, 3)) * np.asarray(field.spacing)

    def total(x):
        return jnp.sum(jnp.sin(50 * field.depth_home(x.T)))

    gradient = jax.grad(total)(jnp.asarray(points))
    np.testing.assert_allclose(gradient, central_difference(jax.jit(total), points), atol=1e-5)
    tables = jnp.asarray(field.coefficients)
    along = jax.jvp(
        lambda c: eqx.tree_at(lambda f: f.coefficients, field, c).depth_home(points.T), (tables,), (tables,)
    )
    np.testing.assert_allclose(*along, atol=1e-12)  # linear in the table, inside the grid


def test_probes_are_skinned_vertices(heavy):
    walk = mf.onto(samples.walk(cycles=1), heavy.skeleton)[::20]
    mine = np.flatnonzero(heavy.part_of_vertex == PARTS.index("left_upper_arm"))[::7]
    kin = mf.forward_kinematics(heavy.skeleton, walk)
    exact = mf.skin(heavy.skin, kin)[0][:, mine]
    told = jnp.moveaxis(make_probes(heavy, "left_upper_arm", mine).positions_world(kin), 1, -1)
    error = np.linalg.norm(told - exact, axis=-1)
    assert np.median(error) < 1e-4 and error.max() < 0.025  # weights of joints further away are left out


def test_girth_of_one_changes_no_bit(average):
    grown = grow(average, {"arms": 1.0, "legs": 1.0, "trunk": 1.0})
    assert np.array_equal(grown.skin.vertices_bind, average.skin.vertices_bind)
    assert np.array_equal(grown.skeleton.offsets, average.skeleton.offsets)


def test_growth_scales_across_the_bone_and_only_there(average):
    grown = grow(average, {"left_arm": 1.5})
    moved = grown.skin.vertices_bind - average.skin.vertices_bind
    positions = bind_pose(average.skeleton)[0]
    elbow, wrist = (positions[average.skeleton.joint(f"left_{r}")] for r in ("forearm", "hand"))
    axis = (wrist - elbow) / np.linalg.norm(wrist - elbow)
    along = (average.skin.vertices_bind - elbow) @ axis
    mine = average.part_of_vertex == PARTS.index("left_forearm")
    middle = mine & (along > 0.09) & (along < 0.15)
    offset = average.skin.vertices_bind[middle] - elbow
    across = offset - (offset @ axis)[:, None] * axis
    np.testing.assert_allclose(moved[middle], 0.5 * across, atol=2e-3)
    right = average.part_of_vertex == PARTS.index("right_forearm")
    assert np.abs(moved[right]).max() == 0.0


def test_trunk_growth_moves_the_limbs_out(average):
    grown = grow(average, {"trunk": 1.4})
    for role in ("left_clavicle", "right_upper_arm", "left_thigh"):
        joint = average.skeleton.joint(role)
        np.testing.assert_allclose(grown.skeleton.offsets[joint], 1.4 * average.skeleton.offsets[joint])


def test_girth_texts():
    assert parse_girth("arms=1.3, trunk=1.5") == {"arms": 1.3, "trunk": 1.5}
    assert parse_girth("1.6") == {"arms": 1.6, "legs": 1.6, "trunk": 1.6}
    for wrong in ("arms", "arms=x", "", "=2"):
        with pytest.raises(mf.InputError, match="arms=1.3"):
            parse_girth(wrong)


def test_a_point_inside_between_two_slices_is_asked_about():
    """Of a spindle of eleven rings, seven slices: under the widest ring, in the slice below it, it is wider than any
    ring of that slice."""
    heights, angles = np.linspace(-0.5, 0.5, 11), np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
    radii = 0.501 - np.abs(heights)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = np.concatenate(
        [np.column_stack([r * ring, np.full(16, h)]) for r, h in zip(radii, heights, strict=True)]
    )
    spindle = trimesh.convex.convex_hull(vertices)
    points = np.array([[0.42, 0.0, -0.075], [0.43, 0.0, -0.075], [0.0, 0.0, 0.0]])
    may = may_be_inside(points, spindle.vertices, np.asarray(spindle.faces))
    depth = inside_depths(points, np.asarray(spindle.vertices), np.asarray(spindle.faces, np.int64))
    assert may[0] and may[2] and (depth > 0).tolist() == [True, False, True]

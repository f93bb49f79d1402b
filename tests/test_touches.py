"""Touches of two skins against the skins themselves."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import motionfit as mf
from motionfit import samples
from motionfit._motion import bind_pose, host_kinematics, rest_motion
from motionfit.adapt._limits import Look, SkinLooks, shown_between, unborne
from motionfit.adapt._touches import (
    HELD,
    KEPT,
    NEVER,
    NONE,
    hold_term,
    touch_term,
    touches_held,
    touches_of,
    touching_on,
)
from motionfit.metrics import insides, nearest_on_skin, posed_vertices, poses_of, shown_before, skin_depths, skin_gaps
from motionfit.shape import grow
from motionfit.shape.pairs import Pair, pairs_of
from motionfit.shape.surface import inside_depths, part_surface

PAIRS = pairs_of("arms")
LOOKS = (1, 6)


@pytest.fixture(scope="module")
def clip(heavy):
    return mf.onto(samples.walk(cycles=1), heavy.skeleton)[:40:4]


def touches_in(character, clip, length=12, looks=LOOKS):
    rotations = host_kinematics(clip)[1]
    found = {i: (vertices, inside) for i, vertices, inside in insides(character, clip, PAIRS)}
    least = np.full(len(PAIRS), 0.004)
    made = {f: touches_of(character, rotations[f], *found[f], least) for f in looks}
    allowed = {f: np.arange(len(PAIRS)) * 0.001 for f in looks}
    return made, touch_term(character, made, np.arange(len(PAIRS)), allowed, clip.frame_count, length)


def test_in_the_pose_that_was_looked_at_a_touch_is_as_deep_as_the_skin_says(heavy, clip):
    looks, term = touches_in(heavy, clip)
    padded = clip[np.minimum(np.arange(12), clip.frame_count - 1)]
    depth = np.asarray(term.depth(mf.forward_kinematics(heavy.skeleton, padded)))
    posed = posed_vertices(heavy, clip).astype(float)
    for frame in LOOKS:
        touches = looks[frame]
        assert len(touches.pairs) > 4
        for k, (pair, vertex) in enumerate(zip(touches.pairs[:KEPT], touches.vertices[:KEPT], strict=True)):
            exact = []
            for part in PAIRS[pair][:2]:
                mesh = part_surface(heavy, part)
                exact.append(inside_depths(posed[frame, [vertex]], posed[frame, mesh.used], mesh.triangles)[0])
            assert depth[frame, k] == pytest.approx(max(exact), abs=1e-5)
            assert np.asarray(term.allowed)[frame, k] == pytest.approx(pair * 0.001)
    # a frame has the touches of the look that is nearest, and what only fills the bucket has none
    assert (np.asarray(term.found)[2, :4] == np.asarray(term.found)[1, :4]).all()
    assert (np.asarray(term.found)[9, :4, 0] == LOOKS[1]).all()
    assert (np.asarray(term.allowed)[clip.frame_count :] == NEVER).all()


def ways_on(character, motion, term):
    """From each vertex to its place [m], on the posed skin."""
    posed, found = posed_vertices(character, motion).astype(float), np.asarray(term.found)
    frames = np.arange(len(posed))[:, None]
    places = np.einsum("tnk,tnka->tna", term.shares, posed[frames[..., None], found[..., 3:]])
    return places - posed[frames, found[..., 2]]


def test_a_touch_follows_its_skins_to_first_order(heavy, clip):
    """In the pose that was looked at the rate of its depth is that of the distance from the vertex to its place."""
    _, term = touches_in(heavy, clip, clip.frame_count)
    shoulder, step, seen = heavy.skeleton.joint("left_upper_arm"), 1e-5, []
    for angle in (step, -step):
        rotations = np.array(clip.rotations, float)
        turned = Rotation.from_quat(rotations[:, shoulder], scalar_first=True) * Rotation.from_rotvec([0, 0, angle])
        rotations[:, shoulder] = turned.as_quat(scalar_first=True)
        moved = dataclasses.replace(clip, rotations=rotations)
        depth = np.asarray(term.depth(mf.forward_kinematics(heavy.skeleton, moved)))
        seen.append((depth[LOOKS, :], np.linalg.norm(ways_on(heavy, moved, term), axis=-1)[LOOKS, :]))
    told, shown = ((a - b) / (2 * step) for a, b in zip(*seen, strict=True))
    real = (np.asarray(term.allowed) < NEVER)[LOOKS, :]
    assert np.abs(shown[real]).max() > 0.1  # [m/rad]
    np.testing.assert_allclose(told[real], shown[real], atol=2e-3)


def test_touches_on_another_body_are_those_of_the_same_vertices(heavy, clip):
    _, term = touches_in(heavy, clip, clip.frame_count)
    body = grow(heavy, {"trunk": 1.1})
    moved = mf.onto(clip, body.skeleton)
    real = np.asarray(term.allowed) < NEVER
    turns, shifts = mf.forward_kinematics(body.skeleton, moved).skin_transforms()
    moves = np.concatenate([np.asarray(turns), np.asarray(shifts)[..., None]], axis=-1)
    told = np.swapaxes(np.moveaxis(moves, 2, 1).reshape(len(moves), 3, -1) @ touching_on(term, body).blend, 1, 2)
    np.testing.assert_allclose(told[real], ways_on(body, moved, term)[real], atol=1e-6)
    itself, blend = (np.swapaxes(np.asarray(t.blend), 1, 2) for t in (touching_on(term, heavy), term))
    np.testing.assert_allclose(itself[real], blend[real], atol=1e-12)


HANDS = tuple(Pair(f"{s}_hand", part, "") for s in ("left", "right") for part in ("torso", f"{s}_thigh", "head"))
HANDS += (Pair("left_upper_arm", "torso", ""),)  # which is inside


def held_in(character, clip, wanted, weight, reach=2, length=12):
    frames, rows = np.nonzero(wanted)
    gaps = nearest_on_skin(character, clip, HANDS, wanted)
    touches = touches_held(character, host_kinematics(clip)[1][frames], rows, gaps)
    return gaps, hold_term(character, touches, frames, reach, np.zeros(wanted.shape), weight, length)


def test_what_is_held_is_as_far_as_the_skin_says(heavy, clip):
    """In the poses that were looked at, outside and inside."""
    everywhere = np.ones((clip.frame_count, len(HANDS)), bool)
    gaps, (term, held) = held_in(heavy, clip, everywhere, np.ones(everywhere.shape))
    padded = clip[np.minimum(np.arange(12), clip.frame_count - 1)]
    told = np.asarray(term.distance(mf.forward_kinematics(heavy.skeleton, padded)))
    shown = skin_gaps(heavy, clip, HANDS)
    assert shown.min() < -0.01 and shown.max() > 0.3 and held.all()
    np.testing.assert_allclose(told[: clip.frame_count, : len(HANDS)], shown, atol=1e-5)
    assert not np.asarray(term.weight)[clip.frame_count :].any()
    posed = posed_vertices(heavy, clip).astype(float)
    for gap, frame in zip(gaps, np.nonzero(everywhere)[0], strict=True):
        np.testing.assert_allclose(gap.vertex_world, posed[frame, gap.vertex], atol=1e-9)
        np.testing.assert_allclose(gap.corners_world, posed[frame, gap.corners], atol=1e-9)
        # gaps are remembered: none may keep a whole posed skin alive
        assert all(x.base is None or x.base.nbytes < 1000 for x in gap[2:])
        assert np.linalg.norm(gap.vertex_world - gap.place_world) == pytest.approx(abs(gap.gap), abs=1e-6)


def test_a_vertex_on_the_other_skin_is_held_along_the_normal_of_its_triangle(heavy, clip):
    """There the way to its place has no direction."""
    wanted = np.zeros((clip.frame_count, len(HANDS)), bool)
    wanted[3, :2] = True  # not the head: what is nearest to a hand far below is its open rim
    gaps, rotations = nearest_on_skin(heavy, clip, HANDS, wanted), host_kinematics(clip)[1][[3, 3]]
    on_it = [gap._replace(gap=0.0, vertex_world=gap.place_world) for gap in gaps]
    away, there = (touches_held(heavy, rotations, np.arange(2), some) for some in (gaps, on_it))
    for k, gap in enumerate(gaps):
        a, b, c = gap.corners_world
        home, now = (Rotation.from_quat(q, scalar_first=True)
                     for q in (bind_pose(heavy.skeleton)[1][there.carried_by[k]], rotations[k, there.carried_by[k]]))  # fmt: skip
        facing = (now * home.inv()).apply(there.normals[k])
        assert np.linalg.norm(facing) == pytest.approx(1.0, abs=1e-6)
        assert abs(facing @ (b - a)) < 1e-6 and abs(facing @ (c - a)) < 1e-6
        assert there.normals[k] @ away.normals[k] > 0.3  # outward, as the way to a vertex outside is


def test_what_is_held_slides_along_a_skin_that_curves_away(heavy, clip):
    """Beside its place a vertex is as far from the other skin as from a sphere of the term's radius that touches it."""
    wanted = np.zeros((clip.frame_count, len(HANDS)), bool)
    wanted[:, 1] = True  # the left hand beside its thigh
    gaps, (term, _) = held_in(heavy, clip, wanted, wanted.astype(float), 0, clip.frame_count)
    term = eqx.tree_at(lambda t: t.radius, term, 1.0)
    shoulder = heavy.skeleton.joint("left_upper_arm")
    rotations = np.array(clip.rotations, float)
    turned = Rotation.from_quat(rotations[:, shoulder], scalar_first=True) * Rotation.from_rotvec([0.03, 0.02, 0.04])
    rotations[:, shoulder] = turned.as_quat(scalar_first=True)
    moved = dataclasses.replace(clip, rotations=rotations)
    told = np.asarray(term.distance(mf.forward_kinematics(heavy.skeleton, moved)))[:, 0]
    posed, aside = posed_vertices(heavy, moved).astype(float), []
    for t, gap in enumerate(gaps):
        vertex, normal = posed[t, gap.vertex], (gap.vertex_world - gap.place_world) / gap.gap
        # the thigh stays where it was: so does the place
        way = vertex - gap.place_world
        aside.append(float(np.linalg.norm(way - (way @ normal) * normal)))
        on_sphere = np.linalg.norm(way + normal) - 1.0
        # to second order: the sphere curves by a^2 / 2 at its surface, and by h of it less at a height h
        assert abs(told[t] - on_sphere) < 0.25 * aside[-1] ** 2 / 2.0 + 2e-6
    assert max(aside) > 0.02  # [m]


def test_a_frame_holds_what_was_looked_at_near_it_and_no_more_than_it_has_room_for(heavy, clip):
    wanted = np.zeros((clip.frame_count, len(HANDS)), bool)
    wanted[1, 0] = wanted[1, 1] = wanted[8, 1] = True
    weight = np.zeros(wanted.shape)
    weight[:, 0], weight[:, 1], weight[:, 5] = 1.0, 0.5, 1.0  # the last has no look
    _, (term, held) = held_in(heavy, clip, wanted, weight)
    assert held[:, 0].tolist() == [True] * 4 + [False] * 6
    assert held[:, 1].tolist() == [True] * 4 + [False] * 2 + [True] * 4 and not held[:, 2:].any()
    assert np.asarray(term.weight).shape == (12, min(HELD, len(HANDS)))
    np.testing.assert_array_equal(
        np.asarray(term.weight)[:10].sum(axis=1), weight[:, 0] * held[:, 0] + 0.5 * held[:, 1]
    )
    none, nothing = held_in(heavy, clip, np.zeros_like(wanted), weight)
    assert none == [] and not nothing[1].any() and not np.asarray(nothing[0].weight).any()


def test_touches_give_way_where_the_skin_is_out_too_far():
    looks = object.__new__(SkinLooks)  # what it decides by, without a body
    looks.own, looks.deepest, looks.eased = np.full((5, 2), 0.01), np.full((5, 2), 0.006), np.zeros((5, 2))
    out = np.zeros((5, 2))
    assert not looks.ease(out, 0.002) and not looks.eased.any()  # too little was found
    looks.deepest[:, 0] = 0.02
    assert not looks.ease(looks.own, 0.002)  # nothing is out farther than it had to
    assert looks.ease(out, 0.002) and (looks.eased == 0.5).all()
    sunk = out.copy()
    sunk[2, 0] = looks.own[2, 0] + 0.008
    for share in (0.25, 0.0):
        assert looks.ease(sunk, 0.002)
        np.testing.assert_array_equal(looks.eased[:, 0], [0.5, share, share, share, 0.5])
        assert (looks.eased[:, 1] == 0.5).all()
    assert not looks.ease(out, 0.002)


def bare_looks(at, frames, own=0.0):
    looks = object.__new__(SkinLooks)  # what it decides by, without a body
    looks.at, looks.frames, looks.pairs = np.array(at), np.arange(frames), PAIRS[:1]
    looks.own, looks.deepest, looks.eased = np.full((len(at), 1), own), *(np.zeros((len(at), 1)) for _ in range(2))
    looks.let_be = np.zeros(0, int)
    return looks


@given(st.sets(st.integers(0, 40), min_size=1), st.integers(41, 60))
def test_a_look_stands_for_the_frames_nearest_to_it(at, frames):
    looks = bare_looks(sorted(at), frames)
    away = np.abs(np.arange(frames)[:, None] - looks.at)
    nearest = away == away.min(axis=1, keepdims=True)
    halves = nearest / nearest.sum(axis=1, keepdims=True)  # a frame as near to two of them is shared
    np.testing.assert_allclose(looks.shares, halves.sum(axis=0) / frames, atol=1e-12)


def test_the_skin_goes_before_the_fields():
    looks = bare_looks([0, 4, 8], 9)
    on_fields = np.array([0.02] * 5 + [0.0, -0.01, -0.03, -0.05])[:, None]
    on_skin = np.array([0.0, 0.03, 0.0])[:, None]  # less than on the fields, more, and apart on both
    loud, quiet = np.zeros(1, bool), np.ones(1, bool)
    told = looks.joined(on_fields, on_skin, loud)[:, 0]
    np.testing.assert_allclose(told[[0, 4, 8]], [0.0, 0.03, -0.05], atol=1e-12)
    np.testing.assert_allclose(told[2], 0.02 + (-0.02 + 0.01) / 2, atol=1e-12)  # half of what each look was off by
    np.testing.assert_allclose(told[6], -0.01 + 0.01 / 2, atol=1e-12)  # that of the last is not known: both are apart
    assert not looks.joined(on_fields, on_skin, quiet).any()


def test_what_the_skin_does_not_bear_out_is_a_phantom():
    at = np.array([0, 2, 4, 6])
    on_fields = np.array([0.01, 0.02, 0.01, 0.03, 0.01, 0.02, -0.01])[:, None]
    on_skin = np.array([0.0, 0.005, 0.02, 0.0])[:, None]
    told = unborne(on_fields, on_skin, at)[:, 0]
    # all of it, half of it, none; nothing is said by a look in which the fields have none, and in between by shares
    np.testing.assert_allclose(told, [0.01, 0.015, 0.005, 0.03 / 4, 0.0, 0.0, 0.0], atol=1e-12)
    assert not unborne(np.full((7, 1), -0.01), on_skin, at).any()


def test_afterwards_only_what_comes_near_is_looked_at_again():
    looks = bare_looks([0, 8], 9)
    seen = []

    def look(motion, at):
        seen.extend(at.tolist())
        return {t: Look(np.array([0.012 if t in (5, 6) else 0.0]), NONE) for t in at.tolist()}

    looks._look, looks._own = look, lambda at: np.zeros((len(at), 1))
    near = np.isin(looks.frames, [5, 6])
    assert looks.look_between(rest_motion(samples.walk().skeleton), near, every=None)
    assert set(seen) == {0, 8, 4, 5, 6, 7} and looks.at.tolist() == [0, 5, 6, 8]  # 4 and 7 beside them


@pytest.mark.parametrize("shown, beside, taken", [
    ({}, [], []),
    ({6: 0.95, 7: 0.92}, [5, 7], [6, 7]),
    ({9: 0.75, 10: 0.95, 11: 0.65}, [9, 11], [9, 10]),  # a hump, of which the solver is to see the flank
    ({6: 2.0}, [5, 7], [6]),
    ({6: 3.0}, [5, 7], []),  # an arm would have to be led out and back for it
    ({0: 0.75, 1: 2.0, 2: 0.95, 6: 0.95}, [1, 3, 5, 7], [1, 2, 6]),
    ({4: 0.95, 5: 1.1}, [3, 5], [5]),  # beside a look
    ({4: 0.95, 5: 0.8}, [3, 5], []),  # which shows the most of it
    ({3: 3.0}, [], []),  # between two frames that show nothing
])  # fmt: skip
def test_what_is_clean_is_looked_at_in_between(shown, beside, taken):
    looks = bare_looks([0, 4, 8, 12], 13)
    looks._own = lambda at: np.full((len(at), 1), 0.02)
    seen = set()

    def look(motion, at):
        seen.update(at.tolist())
        return {t: Look(np.array([0.02 + shown.get(t, 0.0) / 100]), NONE) for t in at.tolist()}

    looks._look = look
    assert looks.look_between(rest_motion(samples.walk().skeleton)) == bool(taken)
    assert seen == {*range(0, 13, 2), *beside}
    assert looks.at.tolist() == sorted([0, 4, 8, 12, *taken])
    assert len(looks.own) == len(looks.deepest) == len(looks.eased) == len(looks.at)


def test_what_is_let_be_is_told(heavy, average, monkeypatch):
    """A single frame that sinks in is no reason to lead an arm out and back, but the status says so."""
    looks, still = bare_looks([0, 4, 8], 9), rest_motion(samples.walk().skeleton)[np.zeros(9, int)]
    looks._own = lambda at: np.full((len(at), 1), 0.02)
    looks.seen = {(t, pose): Look(np.array([0.05 if t == 6 else 0.02]), NONE) for t, pose in enumerate(poses_of(still))}
    assert not looks.look_between(still)
    assert looks.most_seen(still) == pytest.approx(0.03)
    # and where a later round moved it, it is looked at again
    looked = []
    looks._look = lambda motion, at: looked.extend(at.tolist()) or {}
    moved = dataclasses.replace(still, rotations=-np.asarray(still.rotations))  # no pose that was seen
    looks.most_seen(moved)
    assert looked == [6]
    looked.clear()
    looks.most_seen(moved, looks.frames == 3)  # as it is where the fields say so
    assert looked == [3, 6]
    walk = samples.walk(cycles=1)
    assert mf.adapt(walk, heavy, reference=average, blocks=("legs",)).status == "converged"
    monkeypatch.setattr(SkinLooks, "most_seen", lambda *_: 0.011)
    assert mf.adapt(walk, heavy, reference=average, blocks=("legs",)).status == "violations_left"


def test_a_result_is_looked_at_in_every_frame_that_the_solver_sees(heavy, average):
    walk, legs = samples.walk(cycles=1), pairs_of("legs")
    fit = mf.adapt(walk, heavy, reference=average, blocks=("legs",))
    assert set(poses_of(fit.motion[fit.details["frames"]])) <= set(shown_before(heavy, legs))


@pytest.fixture(scope="module")
def kicking(average):
    """Standing at 120 frames per second; in one frame a leg is across the other."""
    rest = rest_motion(average.skeleton)
    rotations = np.repeat(np.asarray(rest.rotations, float), 24, axis=0)
    hip, turn = average.skeleton.joint("left_thigh"), Rotation.from_rotvec([0.0, 0.0, -0.5])
    world = Rotation.from_quat(bind_pose(average.skeleton)[1][hip], scalar_first=True)
    local = Rotation.from_quat(rotations[13, hip], scalar_first=True) * (world.inv() * turn * world)
    rotations[13, hip] = local.as_quat(scalar_first=True)
    return mf.Motion(average.skeleton, np.repeat(np.asarray(rest.root), 24, axis=0), rotations, 1 / 120)


def test_what_is_deep_in_a_frame_that_no_block_saw_is_told(average, heavy, kicking):
    legs = pairs_of("legs")
    deep = skin_depths(average, kicking, legs).depth.max(axis=1)
    assert deep.argmax() == 13 and deep[13] > 0.02
    seen = np.arange(0, 24, 4)
    assert shown_between(kicking, average, None, kicking, legs, seen) == pytest.approx(deep[13])
    # what the reference shows does not count, nor what was seen or lasts from one seen frame to the next
    assert shown_between(kicking, average, average, kicking, legs, seen) == 0.0
    assert shown_between(kicking, average, None, kicking, legs, np.arange(24)) == 0.0
    lasting = kicking[np.where(np.abs(np.arange(24) - 14) <= 2, 13, 0)]
    assert shown_between(lasting, average, None, lasting, legs, seen) == 0.0
    # after the last that was seen nothing says what goes on
    ending = kicking[np.where(np.arange(24) > 21, 13, 0)]
    assert shown_between(ending, average, None, ending, legs, seen) == pytest.approx(deep[13])
    lasting = kicking[np.where(np.arange(24) >= 20, 13, 0)]
    assert shown_between(lasting, average, None, lasting, legs, seen) == pytest.approx(deep[13])
    # longer than what is scored at once, and the frame that is over was not seen
    long = kicking[np.r_[np.zeros(2048, int), 13]]
    assert shown_between(long, average, None, long, legs, np.arange(0, 2049, 3)) == pytest.approx(deep[13])

    assert mf.adapt(kicking, average, reference=average, blocks=("legs",)).status == "converged"
    fit = mf.adapt(kicking, average, blocks=("legs",))
    assert fit.details["frames"].tolist() == seen.tolist()
    assert fit.status == "violations_left"


def test_the_reference_is_looked_at_only_where_something_is_deep():
    looks, asked = bare_looks([0], 4), []
    depths = np.array([[0.0], [0.006], [0.03], [0.012]])
    looks._look = lambda motion, at: {t: Look(depths[t], NONE) for t in at.tolist()}

    def own(at):
        asked.extend(at.tolist())
        return np.full((len(at), 1), 0.01)

    looks._own = own
    excess = looks._excess(rest_motion(samples.walk().skeleton), np.arange(4))
    np.testing.assert_allclose(excess, [0.0, 0.006, 0.02, 0.002])
    assert asked == [2, 3]


def test_no_pose_is_looked_at_twice(heavy, average, clip, monkeypatch):
    looked = []

    def counting(character, motion, pairs):
        for frame in insides(character, motion, pairs):
            looked.append(character.name)
            yield frame

    for module in ("motionfit.adapt._limits", "motionfit.metrics"):
        monkeypatch.setattr(f"{module}.insides", counting)
    for body in (average, heavy):
        body.memo.pop(("shown", PAIRS), None)
    looks = SkinLooks(clip, heavy, average, PAIRS)
    count = len(looks.at)
    assert looked == [average.name] * count
    first, posed = looks.depths(clip), looks.depths_and_touches(clip)
    np.testing.assert_array_equal(first, posed)
    np.testing.assert_array_equal(first, skin_depths(heavy, clip[looks.at], PAIRS).depth)
    elsewhere = dataclasses.replace(clip, root=np.asarray(clip.root) + [3.0, 0.0, 1.0])
    np.testing.assert_array_equal(first, skin_depths(heavy, elsewhere[looks.at], PAIRS).depth)
    assert looked[count:] == [heavy.name] * count
    # one frame moves: it alone is looked at, and what touches in the others is not told twice
    told = {frame: len(touches.pairs) for frame, touches in looks.touches.items()}
    assert max(told.values()) > 0
    rotations = np.array(clip.rotations, float)
    shoulder, turn = heavy.skeleton.joint("left_upper_arm"), Rotation.from_rotvec([0.0, 0.0, 0.2])
    turned = Rotation.from_quat(rotations[3, shoulder], scalar_first=True) * turn
    rotations[3, shoulder] = turned.as_quat(scalar_first=True)
    moved, looked[:] = dataclasses.replace(clip, rotations=rotations), []
    now = looks.depths_and_touches(moved)
    assert looked == [heavy.name]
    assert [i for i in range(count) if (now[i] != first[i]).any()] == [3]
    assert {f for f, t in looks.touches.items() if len(t.pairs) != told[f]} == {3}
    # the reference is known for every body after the first
    looked[:] = []
    np.testing.assert_array_equal(SkinLooks(clip, grow(heavy, {"arms": 1.1}), average, PAIRS).own, looks.own)
    assert looked == []

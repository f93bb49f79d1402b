"""Segment masses, their centres and their inertia, from the shape: thesis 4.7.1 and 5.6.

From the fitted volumes (what the thesis does), from the closed mesh itself (the most that a skin can tell), or
from an anthropometric table scaled to the total mass (what one does without a shape).
"""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from motionfit import rotation
from motionfit._character import Character
from motionfit._motion import bind_pose
from motionfit._skeleton import SIDES, Skeleton
from motionfit._types import AnyArray, InputError
from motionfit.shape.anthropometry import SEGMENTS
from motionfit.shape.cutting import cut_and_cap, solid_moments
from motionfit.shape.volumes import Volumes, bone_tips

# [kg/m^3] Mean density of body parts: thesis table 4.1, from Clauser, McConville & Young 1969 and Chandler et al.
# 1975. That of the torso includes the lungs.
DENSITY: dict[str, float] = {
    "head": 1056.0, "torso": 853.0, "upper_arm": 1004.5, "forearm": 1052.0, "hand": 1080.0,
    "thigh": 1019.5, "calf": 1069.0, "foot": 1071.0,
}  # fmt: skip

# The limbs of tables 5.1 to 5.5.
LIMBS: tuple[str, ...] = ("head", "right_arm", "left_arm", "trunk", "left_leg", "right_leg")

# Thesis table 5.5: what the radii of each limb's volumes are multiplied by, so that the shares of the total mass are
# those measured on its subject. The mass goes with the square (checked against table 5.2, ellipsoids included): the
# scale acts on the two half widths across the bone, not on the length.
RADIUS_SCALES: dict[str, dict[str, float]] = {
    "cylinder": {"head": 0.85, "right_arm": 0.97, "left_arm": 0.90, "trunk": 1.08, "left_leg": 0.97, "right_leg": 0.98},
    "ellipsoid": {"head": 0.98, "right_arm": 1.36, "left_arm": 1.29, "trunk": 0.90, "left_leg": 1.04,
                  "right_leg": 1.14},
}  # fmt: skip


class Masses(eqx.Module):
    """The rigid bodies of a character, one row per segment.

    `mass` [kg]; `centre_joint` [m], the centre of mass in the frame of the joint that carries the segment;
    `inertia_joint` [kg m^2] about that centre, along the axes of the joint's frame.
    """

    roles: tuple[str, ...] = eqx.field(static=True)
    joints: tuple[int, ...] = eqx.field(static=True)
    mass: Float[AnyArray, " segments"]
    centre_joint: Float[AnyArray, "segments 3"]
    inertia_joint: Float[AnyArray, "segments 3 3"]

    def __check_init__(self):
        if isinstance(self.mass, np.ndarray) and not (np.isfinite(self.mass).all() and (self.mass >= 0).all()):
            worst = self.roles[int(np.argmin(np.nan_to_num(self.mass, nan=-np.inf)))]
            raise InputError(f"the mass of {worst} is {np.min(self.mass):g} kg; masses must be finite and not negative")
        if isinstance(self.mass, np.ndarray) and self.mass.sum() <= 0:
            raise InputError("all masses are zero; a body needs some mass")

    @property
    def total(self) -> Float[Array, ""]:
        """[kg]"""
        return jnp.sum(jnp.asarray(self.mass))

    def limbs(self) -> dict[str, float]:
        """Mass [kg] of each limb of thesis table 5.1."""
        mass = np.asarray(self.mass)
        return {limb: float(sum(m for r, m in zip(self.roles, mass, strict=True) if limb_of(r) == limb))
                for limb in LIMBS}  # fmt: skip

    def with_limbs(self, limbs: Mapping[str, float]) -> "Masses":
        """The same bodies with other limb masses [kg]; within a limb the shares stay. (This is how the thesis
        turns masses measured per limb into masses per segment, 5.6.1.)"""
        unknown = set(limbs) - set(LIMBS)
        if unknown:
            raise InputError(f"unknown limb {sorted(unknown)[0]!r}; limbs: {', '.join(LIMBS)}")
        own = self.limbs()
        factor = np.array([limbs.get(limb_of(r), own[limb_of(r)]) / max(own[limb_of(r)], 1e-12) for r in self.roles])
        return Masses(self.roles, self.joints, np.asarray(self.mass) * factor, self.centre_joint,
                      np.asarray(self.inertia_joint) * factor[:, None, None])  # fmt: skip


def limb_of(role: str) -> str:
    """The limb of table 5.1 that a role belongs to."""
    side, _, kind = role.partition("_")
    if side in SIDES and kind != "clavicle":
        return f"{side}_arm" if kind in ("upper_arm", "forearm", "hand") else f"{side}_leg"
    return "head" if role == "head" or role.startswith("neck_") else "trunk"


def density_of(role: str) -> float:
    """Density [kg/m^3] of the segment of a role: thesis table 4.1."""
    kind = {"head": "head", "trunk": "torso"}.get(limb_of(role), role.partition("_")[2])
    return DENSITY["foot" if kind == "toe" else kind]


# --- from the fitted volumes --------------------------------------------------------------------------------------


def volume_masses(volumes: Volumes, radius_scales: Mapping[str, float] | None = None) -> Masses:
    """Masses of cylinders, capsules or ellipsoids: volume x density of table 4.1, and the solid's own inertia.

    `radius_scales` multiplies the half widths per limb: `RADIUS_SCALES[kind]` is table 5.5. Differentiable in the
    volumes. Volumes do not hold which way each half width points, so the two transverse moments of an elliptic
    section are taken equal.
    """
    scales = {} if radius_scales is None else radius_scales
    unknown = set(scales) - set(LIMBS)
    if unknown:
        raise InputError(f"no radius scale for {sorted(unknown)[0]!r}; limbs: {', '.join(LIMBS)}")
    scale = jnp.array([scales.get(limb_of(r), 1.0) for r in volumes.roles])
    density = jnp.array([density_of(r) for r in volumes.roles])
    start, end = jnp.asarray(volumes.start), jnp.asarray(volumes.end)
    radii = jnp.asarray(volumes.radii) * scale[:, None]
    squared = jnp.mean(radii**2, axis=1)  # of the half widths, [m^2]
    length = rotation.safe_norm(end - start)
    axis = rotation.normalize(end - start)
    if volumes.kind == "ellipsoid":
        half = jnp.asarray(volumes.half_length)
        volume = 4 / 3 * jnp.pi * radii[:, 0] * radii[:, 1] * half
        along, across = 2 * squared / 5, (squared + half**2) / 5
    elif volumes.kind == "cylinder":
        volume = jnp.pi * radii[:, 0] * radii[:, 1] * length
        along, across = squared / 2, squared / 4 + length**2 / 12
    else:  # capsule: a cylinder between the ends of the axis, and a half ball on each
        radius = radii.mean(axis=1)
        tube, balls = jnp.pi * radius**2 * length, 4 / 3 * jnp.pi * radius**3
        volume = tube + balls
        along = (tube * radius**2 / 2 + balls * 2 * radius**2 / 5) / volume
        # half balls: their own 2/5 r^2, and the offset of their centres of mass by 3/8 r beyond the ends
        far = 2 * radius**2 / 5 + length**2 / 4 + 3 * length * radius / 8
        across = (tube * (radius**2 / 4 + length**2 / 12) + balls * far) / volume
    mass = density * volume
    outer = axis[:, :, None] * axis[:, None, :]
    inertia = along[:, None, None] * outer + across[:, None, None] * (jnp.eye(3, dtype=outer.dtype) - outer)
    return Masses(volumes.roles, volumes.joints, mass, (start + end) / 2, mass[:, None, None] * inertia)


# --- from the closed mesh -----------------------------------------------------------------------------------------


def segment_of_joint(skeleton: Skeleton) -> list[int]:
    """The joint that carries the rigid segment of each joint's skin: its own where it has a role; clavicles go with
    the chest and toes with the foot, since a slice of so little skin is no solid of its own."""
    merged = {f"{s}_clavicle": "chest" for s in SIDES} | {f"{s}_toe": f"{s}_foot" for s in SIDES}
    result = []
    for joint in range(len(skeleton.names)):
        role = skeleton.nearest_role(joint) or "hips"
        role = merged.get(role, role)
        result.append(joint if (found := skeleton.find(role)) is None else found)
    return result


class _Pieces(eqx.Module):
    """The mesh with every triangle given to a rigid segment; seams welded."""

    vertices: np.ndarray  # bind pose [m]
    faces: np.ndarray
    owner: np.ndarray  # the joint that carries each face


def _pieces(character: Character) -> _Pieces:
    """A triangle belongs to the segment of the joint of greatest weight, (4.2), of two of its corners. Vertices at
    the same place count as one, so that the seams of a textured mesh are no holes."""
    skin = character.skin
    vertices, faces = np.asarray(skin.vertices_bind, float), np.asarray(skin.faces)
    _, kept, welded = np.unique(np.round(vertices, 7), axis=0, return_index=True, return_inverse=True)
    carrier = np.array(segment_of_joint(character.skeleton))[skin.main_joint[kept]]
    faces = welded.reshape(-1)[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    a, b, c = carrier[faces].T
    return _Pieces(vertices[kept], faces, np.where(b == c, b, a))


def mesh_masses(character: Character) -> Masses:
    """Masses of the skin itself, cut where its segments meet and capped: volume x density of table 4.1.

    The pieces fill the mesh exactly, so that nothing is counted twice at the joints.
    """
    skeleton, pieces = character.skeleton, _pieces(character)
    positions, rotations = bind_pose(skeleton)
    rows = []
    for joint, corners in cut_and_cap(pieces.vertices, pieces.faces, pieces.owner).items():
        role = skeleton.role_of_joint.get(joint, "hips")
        volume, centre, second = solid_moments(corners)
        if volume <= 0:  # a sliver turned inside out by the cut: nothing to weigh
            continue
        turn = Rotation.from_quat(rotations[joint], scalar_first=True).as_matrix()
        inertia = np.trace(second) * np.eye(3) - second
        rows.append((role, joint, density_of(role) * volume, turn.T @ (centre - positions[joint]),
                     density_of(role) * turn.T @ inertia @ turn))  # fmt: skip
    if not rows:
        raise InputError(f"{character.name}: the mesh encloses no volume; its triangles may be turned inside out")
    roles, joints, mass, centre, inertia = zip(*rows, strict=True)
    return Masses(roles, joints, np.array(mass), np.array(centre), np.array(inertia))


def mass_volumes(character: Character, kind: str = "cylinder") -> Volumes:
    """One cylinder or ellipsoid per rigid segment, for weighing.

    As in thesis 4.2.1 with its errata, and both ways from the second moments of the segment's surface: a tube of
    radius r and length l has variance r^2/2 across and l^2/12 along. (`fit_volumes` takes the *reach* of the skin
    for the length, so that collisions see all of it; neighbours then overlap at every joint and weigh up to half
    as much again: measured in benchmarks.thesis.masses.) The moments are integrals over the triangles, so the mesh's
    density does not matter; the axis is the principal one nearest to the bone, in the trunk to the spine.
    """
    if kind not in ("cylinder", "ellipsoid"):
        raise InputError(f"no mass volumes of kind {kind!r}; there are cylinder, ellipsoid")
    skeleton, pieces = character.skeleton, _pieces(character)
    positions, rotations = bind_pose(skeleton)
    tips = bone_tips(skeleton)
    spine = positions[skeleton.joint("chest")] - positions[skeleton.joint("hips")]
    rows = []
    for joint in np.unique(pieces.owner):
        role = skeleton.role_of_joint.get(int(joint), "hips")
        a, b, c = np.moveaxis(pieces.vertices[pieces.faces[pieces.owner == joint]], 1, 0)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        centre = area @ (a + b + c) / (3 * area.sum())
        a, b, c = a - centre, b - centre, c - centre
        moments = sum(np.einsum("t,ti,tj->ij", area, v, v) for v in (a, b, c, a + b + c)) / (12 * area.sum())
        bone = spine if limb_of(role) == "trunk" else tips[joint] - positions[joint]
        values, vectors = np.linalg.eigh(moments)
        values = np.maximum(values, 0.0)
        along = int(np.argmax(np.abs(vectors.T @ bone))) if np.linalg.norm(bone) > 1e-6 else 2
        across = [i for i in range(3) if i != along]
        axis, half = vectors[:, along], np.sqrt(3 * values[along])
        round_widths = np.full(2, np.sqrt(values[across].sum()))
        widths = np.sqrt(3 * values[across]) if kind == "ellipsoid" else round_widths
        to_joint = Rotation.from_quat(rotations[joint], scalar_first=True).inv()
        ends = [to_joint.apply(centre + s * half * axis - positions[joint]) for s in (-1.0, 1.0)]
        rows.append((role, int(joint), *ends, widths, half))
    roles, joints, start, end, radii, half = zip(*rows, strict=True)
    return Volumes(kind, roles, joints, np.array(start), np.array(end), np.array(radii), np.array(half))


# --- from an anthropometric table ---------------------------------------------------------------------------------


def anthropometric_masses(character: Character, total: float | None = None, sex: str = "male") -> Masses:
    """Masses, centres and inertia of de Leva 1996, table 4, scaled to the total mass [kg] and the character's bones.

    `total` is that of the closed mesh where it is not given. The table's end points that no joint marks are taken
    from the skin: vertex of the head, heel, tip of the toes, tip of the middle finger.
    """
    total = float(np.sum(mesh_masses(character).mass)) if total is None else float(total)
    if not 1.0 <= total <= 500.0:
        raise InputError(f"a total mass of {total:g} kg; give 1 to 500 kg")
    if sex not in SEGMENTS:
        raise InputError(f"sex {sex!r}: the table of de Leva 1996 has {', '.join(SEGMENTS)}")
    skeleton = character.skeleton
    positions, rotations = bind_pose(skeleton)
    ends = _landmarks(character, sex)
    rows = []
    whole = sum(row.mass for row in SEGMENTS[sex].values())  # the printed shares: 100.00 (men) and 99.99 % (women)
    for role, row in SEGMENTS[sex].items():
        joint = _carrier(skeleton, role, positions, ends)
        start, end = ends[role]
        length = np.linalg.norm(end - start)
        axis = (end - start) / max(length, 1e-9)
        side = np.array([1.0, 0.0, 0.0]) - axis[0] * axis  # the transverse axis: left-right in the bind pose
        side = side / np.linalg.norm(side) if np.linalg.norm(side) > 0.5 else np.cross(axis, [0.0, 0.0, 1.0])
        frame = np.stack([np.cross(side, axis), side, axis])  # rows: sagittal, transverse, longitudinal
        mass = row.mass / whole * total
        inertia = frame.T @ np.diag(mass * (np.array(row.gyration) * length) ** 2) @ frame
        turn = Rotation.from_quat(rotations[joint], scalar_first=True).as_matrix()
        centre = turn.T @ (start + row.centre * (end - start) - positions[joint])
        rows.append((skeleton.role_of_joint.get(joint, role), joint, mass, centre, turn.T @ inertia @ turn))
    roles, joints, mass, centre, inertia = zip(*rows, strict=True)
    return Masses(roles, joints, np.array(mass), np.array(centre), np.array(inertia))


def _landmarks(character: Character, sex: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Bind positions [m] of both end points of every row of the table."""
    skeleton = character.skeleton
    positions = bind_pose(skeleton)[0]
    vertices = np.asarray(character.skin.vertices_bind, float)
    owner = np.array(segment_of_joint(skeleton))[character.skin.main_joint]

    def at(role: str) -> np.ndarray:
        return positions[skeleton.joint(role)]

    def farthest(role: str, direction: np.ndarray) -> np.ndarray:
        mine = vertices[owner == skeleton.joint(role)]
        return mine[(mine @ direction).argmax()] if len(mine) else at(role)

    up = np.array([0.0, 1.0, 0.0])
    head, neck = skeleton.joint("head"), skeleton.chain("neck")
    crown = farthest("head", up)
    # along the trunk, from the shoulders' middle (a little below the suprasternale) to the hips' middle
    shoulders = (at("left_upper_arm") + at("right_upper_arm")) / 2
    hips = (at("left_thigh") + at("right_thigh")) / 2
    upper, middle, lower = {"male": (170.7, 215.5, 145.7), "female": (142.5, 205.3, 181.5)}[sex]  # [mm], table 2
    below = {"male": 515.5, "female": 497.9}[sex]  # [mm], shoulders' to hips' middle
    top = hips + (shoulders - hips) * (upper + middle + lower) / below
    xiphion = top + (hips - top) * upper / (upper + middle + lower)
    navel = hips + (top - hips) * lower / (upper + middle + lower)
    ends = {
        "head": (np.array([positions[head][0], crown[1], positions[head][2]]), positions[neck[0] if neck else head]),
        "chest": (top, xiphion), "spine": (xiphion, navel), "hips": (navel, hips),
    }  # fmt: skip
    for s in SIDES:
        ends[f"{s}_upper_arm"] = (at(f"{s}_upper_arm"), at(f"{s}_forearm"))
        ends[f"{s}_forearm"] = (at(f"{s}_forearm"), at(f"{s}_hand"))
        out = at(f"{s}_hand") - at(f"{s}_forearm")
        ends[f"{s}_hand"] = (at(f"{s}_hand"), farthest(f"{s}_hand", out))
        ends[f"{s}_thigh"] = (at(f"{s}_thigh"), at(f"{s}_calf"))
        ends[f"{s}_calf"] = (at(f"{s}_calf"), at(f"{s}_foot"))
        forward = bone_tips(skeleton)[skeleton.joint(f"{s}_foot")] - at(f"{s}_foot")
        forward = np.array([forward[0], 0.0, forward[2]]) if np.hypot(*forward[[0, 2]]) > 1e-6 else np.eye(3)[2]
        ends[f"{s}_foot"] = (farthest(f"{s}_foot", -forward), farthest(f"{s}_foot", forward))
    return ends


def _carrier(skeleton: Skeleton, role: str, positions: np.ndarray, ends: dict) -> int:
    """The joint that carries a row of the table; the middle trunk goes with the highest spine joint below it."""
    if role != "spine":
        return skeleton.joint(role)
    middle = float(np.mean([end[1] for end in ends[role]]))
    below = [j for j in skeleton.chain("spine") if positions[j][1] <= middle]
    return below[-1] if below else skeleton.joint("hips")

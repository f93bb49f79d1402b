"""Balance: centre of mass, momentum, the zero-moment point, support polygons and the distance between them.

Thesis 4.7 and 5.6. The zero-moment point (ZMP) is where the ground's reaction would have to act so that it has no
horizontal moment; while it lies in the support polygon the feet need not be moved to keep from falling.

The filter. Accelerations are second derivatives, which amplify the noise of a captured motion with the square of the
frequency; the thesis filters by resampling to 25 Hz. Here every frame gets the least-squares quadratic of its
neighbourhood, weighted by a Gaussian of standard deviation `window` [s] (Savitzky & Golay 1964; Cleveland 1979), and
value, velocity and acceleration are the quadratic's. Why this one: it is linear in the motion and hence differentiable;
it has no phase lag; rest, constant velocity and constant acceleration (flight) pass through it exactly; and the first
and last frames get a one-sided fit instead of an invented continuation. The frequency response of
all three is that of the Gaussian, exp(-(2 pi f window)^2 / 2): with the default window 98, 93, 75, 53 and 17 % at
1, 2, 4, 6 and 10 Hz, near the 6 Hz that gait analysis cuts at (Winter 2009).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from motionfit import rotation
from motionfit._character import PARTS, Character
from motionfit._motion import Kinematics, bind_pose
from motionfit._skeleton import SIDES
from motionfit._types import AnyArray, InputError
from motionfit.shape.mass import LIMBS, Masses, limb_of

GRAVITY = 9.81  # [m/s^2]
WINDOW = 0.03  # [s]
REACH = 32  # frames on each side that the filter sees: 3.5 windows at 300 frames per second
FLIGHT = 0.2  # below this share of the weight the ground carries too little: the ZMP runs away, frames are left out


# --- time derivatives ---------------------------------------------------------------------------------------------


def smooth_derivatives(
    x: Float[AnyArray, "frames ..."], dt: Float[AnyArray, ""], window: float | Float[AnyArray, ""] = WINDOW
) -> tuple[Array, Array, Array]:
    """Filtered value, velocity [1/s] and acceleration [1/s^2] of a signal: the module's filter.

    `window` [s] of 0 takes the narrowest that still fits a quadratic, about one frame: central differences.
    """
    x = jnp.asarray(x)
    frames = x.shape[0]
    dt = jnp.asarray(dt, x.dtype)
    if frames < 3:  # no quadratic through one or two frames
        speed = jnp.zeros_like(x) if frames == 1 else jnp.broadcast_to((x[1:] - x[:-1]) / dt, x.shape)
        return x, speed, jnp.zeros_like(x)
    reach = min(REACH, frames - 1)
    sigma = jnp.maximum(jnp.asarray(window, x.dtype) / dt, 0.6)  # [frames]
    step = jnp.arange(-reach, reach + 1)
    index = jnp.arange(frames)[:, None] + step
    inside = (index >= 0) & (index < frames)
    tau = step.astype(x.dtype) / sigma  # in windows: the normal equations are then well scaled
    weight = jnp.where(inside, jnp.exp(-0.5 * tau * tau), 0.0)
    powers = jnp.stack([jnp.ones_like(tau), tau, tau * tau])  # (3, steps)
    normal = jnp.einsum("tk,ak,bk->tab", weight, powers, powers)
    fit = jnp.linalg.solve(normal, weight[:, None] * powers)  # (frames, 3, steps): coefficients of the quadratic
    near = x.reshape(frames, -1)[jnp.clip(index, 0, frames - 1)]
    coefficients = jnp.einsum("tak,tkc->atc", fit, near).reshape(3, *x.shape)
    return coefficients[0], coefficients[1] / (sigma * dt), 2 * coefficients[2] / (sigma * dt) ** 2


def _from_half_steps(steps: Array, frames: int) -> Array:
    """Rates at the frames from those half-way between them: the mean of both neighbours; linear at the ends."""
    if frames == 1:
        return jnp.zeros((1, *steps.shape[1:]), steps.dtype)
    if frames == 2:
        return jnp.concatenate([steps, steps])
    inner = (steps[1:] + steps[:-1]) / 2
    return jnp.concatenate([1.5 * steps[:1] - 0.5 * steps[1:2], inner, 1.5 * steps[-1:] - 0.5 * steps[-2:-1]])


def velocities(x: Float[AnyArray, "frames ..."], dt: Float[AnyArray, ""]) -> Float[Array, "frames ..."]:
    """Unfiltered velocity: central differences, exact for quadratics up to the ends."""
    x = jnp.asarray(x)
    return _from_half_steps((x[1:] - x[:-1]) / jnp.asarray(dt, x.dtype), x.shape[0])


def angular_velocities(
    rotations_world: Float[AnyArray, "frames ... 4"], dt: Float[AnyArray, ""]
) -> Float[Array, "frames ... 3"]:
    """World angular velocity [rad/s] from unit quaternions, unfiltered; exact for a constant spin."""
    q = jnp.asarray(rotations_world)
    steps = rotation.log(rotation.multiply(q[1:], rotation.conjugate(q[:-1]))) / jnp.asarray(dt, q.dtype)
    return _from_half_steps(steps, q.shape[0])


# --- mass and momentum --------------------------------------------------------------------------------------------


def centres_world(kin: Kinematics, masses: Masses) -> Float[Array, "frames segments 3"]:
    """Centre of mass [m] of every segment."""
    joints = np.array(masses.joints)
    local = jnp.asarray(masses.centre_joint).astype(kin.rotations_world.dtype)
    return jnp.asarray(kin.positions_world)[:, joints] + rotation.rotate(kin.rotations_world[:, joints], local[None])


def _shares(masses: Masses, dtype) -> Float[Array, " segments"]:
    mass = jnp.asarray(masses.mass).astype(dtype)
    return mass / jnp.sum(mass)


def centre_of_mass(kin: Kinematics, masses: Masses) -> Float[Array, "frames 3"]:
    """Centre of mass of the whole body [m]."""
    centres = centres_world(kin, masses)
    return jnp.einsum("s,tsa->ta", _shares(masses, centres.dtype), centres)


def linear_momentum(kin: Kinematics, masses: Masses) -> Float[Array, "frames 3"]:
    """[kg m/s], unfiltered."""
    com = centre_of_mass(kin, masses)
    return jnp.sum(jnp.asarray(masses.mass)).astype(com.dtype) * velocities(com, kin.dt)


def spin_momenta(kin: Kinematics, masses: Masses) -> Float[Array, "frames segments 3"]:
    """Angular momentum [kg m^2/s] of every segment about its own centre: R I R^T omega."""
    turn = kin.rotations_world[:, np.array(masses.joints)]
    omega = rotation.rotate(rotation.conjugate(turn), angular_velocities(turn, kin.dt))
    inertia = jnp.asarray(masses.inertia_joint).astype(turn.dtype)
    return rotation.rotate(turn, jnp.einsum("sab,tsb->tsa", inertia, omega))


def angular_momentum(kin: Kinematics, masses: Masses, spin: bool = True) -> Float[Array, "frames 3"]:
    """Angular momentum [kg m^2/s] about the body's centre of mass, unfiltered.

    With `spin` the segments' own momentum counts; without it they are the thesis's point masses.
    """
    centres = centres_world(kin, masses)
    share = _shares(masses, centres.dtype)
    total = jnp.sum(jnp.asarray(masses.mass)).astype(centres.dtype)
    arm = centres - jnp.einsum("s,tsa->ta", share, centres)[:, None]
    momentum = total * jnp.einsum("s,tsa->ta", share, jnp.cross(arm, velocities(arm, kin.dt)))
    return momentum + jnp.sum(spin_momenta(kin, masses), axis=1) if spin else momentum


class Zmp(eqx.Module):
    """`point_world` [m], on the ground; `load`, the ground's vertical force over the weight: 1 at rest, 0 in flight."""

    point_world: Float[AnyArray, "frames 3"]
    load: Float[AnyArray, " frames"]


def _number(x) -> Array:
    """A Python number would be static under jit, and each new one would compile again."""
    return jnp.asarray(x, dtype=float)


def zero_moment_point(
    kin: Kinematics,
    masses: Masses,
    *,
    spin: bool = True,
    ground: float | Float[AnyArray, "*frames"] = 0.0,
    window: float | Float[AnyArray, ""] = WINDOW,
) -> Zmp:
    """The zero-moment point: thesis 4.7, after Takanishi & Kato.

    The printed sum over the bodies is written about the centre of mass c, with the total mass M and the momentum k
    about c: x = c_x + (dk_z/dt / M - c_y c_x'') / (c_y'' + g), z = c_z - (dk_x/dt / M + c_y c_z'') / (c_y'' + g). The
    two are equal; this form needs the filter for six signals instead of three per body, and a clip far from the origin
    loses no digits. `spin` adds the segments' own angular momentum, which the thesis leaves out. y is measured from
    `ground` [m], one height or one per frame.

    In flight the denominator vanishes: it is held above `FLIGHT` g, so that nothing is infinite; `load` tells those
    frames, and every measure here leaves them out.
    """
    return _zero_moment_point(kin, masses, _number(ground), _number(window), spin)


@eqx.filter_jit
def _zero_moment_point(kin, masses, ground, window, spin: bool) -> Zmp:
    com = centre_of_mass(kin, masses)
    total = jnp.sum(jnp.asarray(masses.mass)).astype(com.dtype)
    both = jnp.concatenate([com, angular_momentum(kin, masses, spin) / total], axis=-1)
    smoothed, rates, seconds = smooth_derivatives(both, kin.dt, window)
    com, moment, acceleration = smoothed[:, :3], rates[:, 3:], seconds[:, :3]
    load = acceleration[:, 1] / GRAVITY + 1.0
    held = GRAVITY * jnp.maximum(load, FLIGHT)
    floor = jnp.broadcast_to(jnp.asarray(ground, com.dtype), load.shape)
    height = com[:, 1] - floor
    x = com[:, 0] + (moment[:, 2] - height * acceleration[:, 0]) / held
    z = com[:, 2] - (moment[:, 0] + height * acceleration[:, 2]) / held
    return Zmp(jnp.stack([x, floor, z], axis=-1), load)


# --- support ------------------------------------------------------------------------------------------------------


class Soles(eqx.Module):
    """The sole box of the left and the right foot: four corners each, in the frame of the foot's joint [m]."""

    joints: tuple[int, int] = eqx.field(static=True)
    corners_joint: Float[AnyArray, "feet 4 3"]

    def corners_world(self, kin: Kinematics) -> Float[Array, "frames feet 4 3"]:
        joints = np.array(self.joints)
        turn = kin.rotations_world[:, joints][:, :, None]
        local = jnp.asarray(self.corners_joint).astype(turn.dtype)
        return jnp.asarray(kin.positions_world)[:, joints][:, :, None] + rotation.rotate(turn, local[None])


def sole_boxes(character: Character, thickness: float = 0.03) -> Soles:
    """The bounding box of each foot's sole, along the foot: thesis figure 4.13 and 5.6.1.

    The sole are the foot's vertices within `thickness` [m] of its lowest one.
    """
    skeleton = character.skeleton
    positions, rotations = bind_pose(skeleton)
    vertices = np.asarray(character.skin.vertices_bind, float)
    boxes, joints = [], []
    for side in SIDES:
        joint, toe = skeleton.joint(f"{side}_foot"), skeleton.find(f"{side}_toe")
        points = vertices[character.part_of_vertex == PARTS.index(f"{side}_foot")]
        if len(points) < 3:
            raise InputError(f"{character.name}: the {side} foot has {len(points)} vertices, no sole to stand on; "
                             "check the skin weights and the role mapping")  # fmt: skip
        floor = points[:, 1].min()
        sole = points[points[:, 1] <= floor + thickness]
        ahead = (points.mean(0) if toe is None else positions[toe]) - positions[joint]
        ahead = np.array([ahead[0], 0.0, ahead[2]])
        ahead = ahead / np.linalg.norm(ahead) if np.linalg.norm(ahead) > 1e-6 else np.array([0.0, 0.0, 1.0])
        across = np.cross([0.0, 1.0, 0.0], ahead)
        low, high = (sole @ np.stack([across, ahead], axis=1)).min(0), (sole @ np.stack([across, ahead], axis=1)).max(0)
        corners = [x * across + z * ahead + [0.0, floor, 0.0]
                   for x, z in ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))]  # fmt: skip
        to_joint = Rotation.from_quat(rotations[joint], scalar_first=True).inv()
        boxes.append(to_joint.apply(np.array(corners) - positions[joint]))
        joints.append(joint)
    return Soles((joints[0], joints[1]), np.array(boxes))


def hull_distance(
    point: Float[AnyArray, "*batch 2"],
    corners: Float[AnyArray, "*batch corners 2"],
    present: Bool[AnyArray, "*batch corners"],
) -> Float[Array, "*batch"]:
    """Signed distance [m] of points to the convex hull of corners in the plane: positive outside, negative inside.

    The hull is found here, for any order of the corners and any number of them `present` (padding is free): a pair of
    corners is an edge where all others lie on its left. So it is jitted and differentiable, feet that move included.
    A hull of two corners is a line, of one a point; without any the distance is 0.
    """
    corners, point = jnp.asarray(corners), jnp.asarray(point)
    some = jnp.any(present, axis=-1)
    anchor = jnp.take_along_axis(corners, jnp.argmax(present, axis=-1)[..., None, None], axis=-2)
    # relative to the point: what is left of a long path's coordinates keeps its digits
    p = jnp.where(jnp.asarray(present)[..., None], corners, anchor) - point[..., None, :]
    first, second, along, within = _nearest_edge(jax.lax.stop_gradient(p))
    # which point of which edge is nearest is a minimum: to first order the distance does not depend on the choice
    a, b = (jnp.take_along_axis(p, k[..., None, None], axis=-2)[..., 0, :] for k in (first, second))
    distance = rotation.safe_norm(a + along[..., None] * (b - a))
    return jnp.where(some, jnp.where(within, -distance, distance), 0.0)


def _nearest_edge(p: Float[Array, "*batch corners 2"]) -> tuple[Array, Array, Array, Array]:
    """The hull's edge nearest to the origin: its corners, how far along it (0..1), and whether the origin is inside."""
    count = p.shape[-2]
    a, edge = p[..., :, None, :], p[..., None, :, :] - p[..., :, None, :]
    length = rotation.safe_norm(edge)
    to_all = p[..., None, None, :, :] - a[..., None, :]
    side = edge[..., None, 0] * to_all[..., 1] - edge[..., None, 1] * to_all[..., 0]
    left = jnp.all(side >= -1e-6 * length[..., None], axis=-1)  # within 1 um of the line counts as on it
    is_edge = left & (length > 1e-6)
    along = -jnp.sum(a * edge, axis=-1) / jnp.where(length > 1e-6, length * length, 1.0)
    along = jnp.clip(along, 0.0, 1.0)
    gap = rotation.safe_norm(a + along[..., None] * edge)
    inner = jnp.where(is_edge, edge[..., 1] * a[..., 0] - edge[..., 0] * a[..., 1] >= 0, True)
    # corners all on one line make edges both ways, and enclose nothing
    flat = jnp.max(jnp.where(is_edge[..., None], side - 1e-6 * length[..., None], -1.0), axis=(-3, -2, -1)) <= 0
    within = jnp.all(inner, axis=(-2, -1)) & ~flat
    # a corner by itself is part of the hull, never nearer than it: it serves where there is no edge
    candidate = is_edge | (jnp.eye(count, dtype=bool) & ~within[..., None, None])
    flattened = jnp.where(candidate, gap, jnp.inf).reshape(*gap.shape[:-2], count * count)
    nearest = jnp.argmin(flattened, axis=-1)
    along = jnp.take_along_axis(along.reshape(flattened.shape), nearest[..., None], axis=-1)[..., 0]
    return nearest // count, nearest % count, along, within


def nearest_in_hull(
    point: Float[AnyArray, "*batch 2"],
    corners: Float[AnyArray, "*batch corners 2"],
    present: Bool[AnyArray, "*batch corners"],
) -> Float[Array, "*batch 2"]:
    """The point of the hull nearest to each point; points inside stay. (The gradient of a distance points away from
    what it is measured to.)"""
    point = jnp.asarray(point)
    distance, pull = jax.vjp(lambda p: hull_distance(p, corners, present), point)
    (away,) = pull(jnp.ones_like(distance))
    return point - jnp.maximum(distance, 0.0)[..., None] * away


def support_polygon(corners: Float[AnyArray, "corners 2"]) -> Float[np.ndarray, "hull 2"]:
    """The corners of the convex hull in order around it, on the host (SciPy); for plots and files."""
    from scipy.spatial import ConvexHull, QhullError

    corners = np.asarray(corners, float)
    try:
        return corners[ConvexHull(corners).vertices]
    except (QhullError, ValueError):  # a line or a point has no hull of its own
        return np.unique(corners, axis=0)


def support_distance(
    point_world: Float[AnyArray, "frames 3"], corners_world: Float[AnyArray, "frames feet 4 3"],
    planted: Bool[AnyArray, "_ _"],
) -> Float[Array, " frames"]:  # fmt: skip
    """Signed horizontal distance [m] from the support polygon, the hull of the planted soles: positive outside.

    Frames without a planted foot have no support: 0, and to be left out.
    """
    frames = point_world.shape[0]
    if planted.shape != (frames, corners_world.shape[1]):
        raise InputError(f"planted has shape {planted.shape}; it says for each of {frames} frames whether the left and "
                         f"the right foot is down: ({frames}, {corners_world.shape[1]})")  # fmt: skip
    corners = jnp.asarray(corners_world).reshape(frames, -1, 3)[..., np.array([0, 2])]
    present = jnp.repeat(jnp.asarray(planted), 4, axis=1)
    return hull_distance(jnp.asarray(point_world)[:, np.array([0, 2])], corners, present)


class ZmpDistance(eqx.Module):
    """Per frame: the signed distance [m] of the ZMP from its support, and whether there is a support to speak of (a
    planted foot that carries weight)."""

    signed: Float[AnyArray, " frames"]
    supported: Bool[AnyArray, " frames"]

    @property
    def outside(self) -> Float[AnyArray, " frames"]:
        """Distance [m] from the support, 0 inside it and without one."""
        xp = np if isinstance(self.signed, np.ndarray) else jnp  # NumPy compiles nothing for a clip's length
        return xp.where(self.supported, xp.maximum(self.signed, 0.0), 0.0)


def zmp_distance(
    kin: Kinematics,
    masses: Masses,
    soles: Soles,
    planted: Bool[AnyArray, "frames feet"],
    *,
    spin: bool = True,
    ground: float | Float[AnyArray, "*frames"] = 0.0,
    window: float | Float[AnyArray, ""] = WINDOW,
) -> ZmpDistance:
    """How far the ZMP is from the support in every frame.

    Of the original motion on the original body its `outside` are the thresholds zmp_i of thesis 4.7.2.
    """
    return _zmp_distance(kin, masses, soles, planted, _number(ground), _number(window), spin)


@eqx.filter_jit
def _zmp_distance(kin, masses, soles, planted, ground, window, spin: bool) -> ZmpDistance:
    zmp = _zero_moment_point(kin, masses, ground, window, spin)
    signed = support_distance(zmp.point_world, soles.corners_world(kin), planted)
    return ZmpDistance(signed, jnp.any(jnp.asarray(planted), axis=1) & (zmp.load > FLIGHT))


def balance_measures(distance: ZmpDistance, reference: ZmpDistance | None = None) -> dict:
    """report.json's balance entry, over the supported frames: mean and standard deviation of the ZMP's distance from
    its support [m], the mean of what goes beyond the reference's distance in the same frame [m], and how many
    frames are supported. None where nothing is supported, or there is no reference."""
    supported = np.asarray(distance.supported)
    outside = np.asarray(distance.outside, float)
    result: dict = dict.fromkeys(("zmp_distance_mean_m", "zmp_distance_sd_m", "excess_over_reference_mean_m"))
    if supported.any():
        result["zmp_distance_mean_m"] = float(outside[supported].mean())
        result["zmp_distance_sd_m"] = float(outside[supported].std())
    if reference is not None:
        if len(reference.supported) != len(supported):
            raise InputError(f"the reference has {len(reference.supported)} frames, the motion {len(supported)}")
        both = supported & np.asarray(reference.supported)
        if both.any():
            excess = outside[both] - np.asarray(reference.outside, float)[both]
            result["excess_over_reference_mean_m"] = float(np.maximum(excess, 0.0).mean())
    return result | {"supported_frames": int(supported.sum())}


# --- masses that make the motion look balanced --------------------------------------------------------------------


def optimised_masses(
    kin: Kinematics, masses: Masses, soles: Soles, planted: Bool[AnyArray, "frames feet"], **options: float
) -> Masses:
    """Limb masses that bring the ZMP as near to the support as they can: [SKG03] as thesis 5.6 tried it.

    Six limb masses, none negative, of the same total; within a limb the shares of `masses` stay. Point masses, as
    there; SciPy's SLSQP in the place of RFSQP. The thesis found the masses unrealistic and the ZMP worse (tables 5.3,
    F.1 to F.3): it is here to show that. `options` go to `zero_moment_point`.
    """
    from scipy.optimize import minimize

    start = masses.limbs()
    shares = np.array([start[limb] for limb in LIMBS])
    if shares.min() <= 0:
        raise InputError(f"no mass on the {LIMBS[int(shares.argmin())]}: nothing to share out there")
    limb = np.array([LIMBS.index(limb_of(role)) for role in masses.roles])
    numbers = {"ground": 0.0, "window": WINDOW} | options
    setting = (kin, masses, soles, planted, shares / shares.sum(), limb, *(_number(numbers[k]) for k in numbers))

    def host(x):
        value, gradient = _imbalance(jnp.asarray(x), *setting)
        return float(value), np.asarray(gradient, float)

    found = minimize(
        host, shares / shares.sum(), jac=True, method="SLSQP", bounds=[(0.0, 1.0)] * len(LIMBS),
        constraints={"type": "eq", "fun": lambda x: x.sum() - 1.0, "jac": lambda x: np.ones_like(x)},
        options={"maxiter": 200, "ftol": 1e-8},
    )  # fmt: skip
    best = np.clip(found.x if np.isfinite(found.x).all() else shares / shares.sum(), 0.0, None)
    return masses.with_limbs(dict(zip(LIMBS, best / best.sum() * shares.sum(), strict=True)))


@eqx.filter_jit
@eqx.filter_value_and_grad
def _imbalance(x, kin, masses, soles, planted, shares, limb, ground, window):
    """Mean squared distance [cm^2] of the point masses' ZMP from its support, for limb shares x: SLSQP's stopping rule
    is absolute, hence the centimetres."""
    mass = jnp.asarray(masses.mass) * (x / shares)[limb]
    scaled = Masses(masses.roles, masses.joints, mass, masses.centre_joint, masses.inertia_joint)
    distance = _zmp_distance(kin, scaled, soles, planted, ground, window, False)
    return 1e4 * jnp.sum(distance.outside**2) / jnp.maximum(jnp.sum(jnp.where(distance.supported, 1.0, 0.0)), 1.0)

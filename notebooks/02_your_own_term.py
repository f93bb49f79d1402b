# %% [markdown]
# # Your own term
#
# An adaptation objective is a dictionary of terms: residuals over the kinematics, each divided by the error that
# "counts as 1". Here one is written, varied, solved in several ways, judged by the skin and differentiated.
# Lengths are metres, angles radians, times seconds; y is up, z the way of the walk.

# %%
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import matplotlib.pyplot as plt
import numpy as np
import optimistix as optx

import motionfit as mf
from motionfit.metrics import skin_depths
from motionfit.samples import walk

clip = walk(cycles=1)
body, reference = mf.load_character("builtin:heavy"), mf.load_character("builtin:average")
base = mf.onto(clip, body.skeleton)
seconds = np.arange(base.frame_count) * float(base.dt)

# %% [markdown]
# ## A term and two controls
#
# The wish: elbows and wrists stay outside a capsule around the line from hips to chest. The function sees all joints
# in all frames; rows have the frames first. Numbers that may change go in `args`. Each row looks at its own frame
# alone, which `reach=0` says: the normal equations are then banded in time.

# %%
joint = body.skeleton.joint
ARMS = np.array([joint(f"{side}_{part}") for side in ("left", "right") for part in ("forearm", "hand")])


def gap(kin, radius):
    """How far [m] elbows and wrists are outside the capsule; negative inside."""
    start, end = (kin.positions_world[:, None, joint(role)] for role in ("hips", "chest"))
    points, along = kin.positions_world[:, ARMS], end - start
    share = jnp.sum((points - start) * along, axis=-1) / jnp.sum(along * along, axis=-1)
    return mf.rotation.safe_norm(points - start - jnp.clip(share, 0.0, 1.0)[..., None] * along) - radius


def keep_out(kin, radius):
    return jnp.maximum(-gap(kin, radius), 0.0) / 0.01  # 1 cm inside counts as 1


def sideways(side, axis_parent):
    """One signal [rad] that leads an arm out: the shoulder about the forward axis of the clavicle."""
    basis = mf.splines.bspline_basis(base.frame_count, float(base.dt), 0.1)  # a control point every 0.1 s
    return mf.Control(f"{side}_arm", (mf.Drive(joint(f"{side}_upper_arm"), np.array(axis_parent), 1.0),), basis)


controls = (sideways("left", [0.0, 0.0, 1.0]), sideways("right", [0.0, 0.0, -1.0]))
quiet = {"effort": mf.terms.Effort(0.07), "smoothness": mf.terms.Smoothness(200.0)}  # [rad], [rad/s^3]
own = mf.Custom(keep_out, 0.30, reach=0)
problem = mf.Problem(body, base, {"keep_out": own, **quiet}, controls)
block = mf.Block("arms", ("left_arm", "right_arm"), max_steps=80)
fit = mf.fit(problem, (block,))
print(problem.report(), "\n\nafter the fit:\n", problem.report(fit.correction), sep="\n")

# %% [markdown]
# ## Variants
#
# Weights are linear in the cost, 1 where not given. `Robust` is linear beyond `c`: what is far off pulls no harder.
# `During` multiplies rows by a mask. A block takes any optimistix solver; an `Energy`, a scalar, needs a minimiser such
# as BFGS. Each fit is judged by what its solver does not see: how much deeper than on the reference the arms are in
# the trunk, on the skinned mesh, in every fourth frame. The time is a second run's.


# %%
def rounded(kin, radius):
    return jnp.sum(jax.nn.softplus(-gap(kin, radius) / 0.005))


dense = optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5, linear_solver=lx.Normal(lx.Cholesky()))
bfgs = optx.BFGS(rtol=1e-3, atol=1e-3)
half = np.where(seconds < seconds[-1] / 2, 1.0, 0.0)
variants = {
    "least squares": (own, {}, block),
    "weight 10": (own, {"keep_out": 10.0}, block),
    "robust": (mf.Robust(own, 1.0), {}, block),
    "first half": (mf.During(own, half), {}, block),
    "dense LM": (own, {}, mf.Block("arms", block.controls, solver=dense)),
    "energy, BFGS": (mf.Energy(rounded, 0.30), {}, mf.Block("arms", block.controls, solver=bfgs, max_steps=400)),
}
trunk = [k for k, pair in enumerate(mf.shape.PAIRS) if pair.second == "torso"]
at_ease = skin_depths(reference, clip, step=4).depth[:, trunk]


def skin_excess(motion):
    return max(0.0, float((skin_depths(body, motion, step=4).depth[:, trunk] - at_ease).max()))  # [m]


print(f"{'nothing done':<14} skin {100 * skin_excess(base):3.1f} cm")
fits, excess = {}, {}
for name, (term, weights, free) in variants.items():
    varied = mf.Problem(body, base, {"keep_out": term, **quiet}, controls, weights)
    mf.fit(varied, (free,))  # compiles
    fits[name] = mf.fit(varied, (free,))
    done = fits[name].history[0]
    excess[name] = skin_excess(fits[name].motion)
    print(f"{name:<14} skin {100 * excess[name]:3.1f} cm, cost {done.cost_before:7.1f} -> {done.cost_after:6.1f} "
          f"in {done.accepted_steps:2} steps and {1000 * done.time_s:4.0f} ms: {done.status}")  # fmt: skip

# %%
figure, axes = plt.subplots(2, 1, figsize=(9, 4.8), sharex=True, constrained_layout=True)
clearance = eqx.filter_jit(lambda signals: 100 * gap(problem.kinematics(signals), 0.30)[:, 0])  # [cm]
axes[1].plot(seconds, clearance(None), "k:", label="nothing done")
for name, solved in fits.items():
    signals = solved.correction.signals()
    line = "--" if name == "dense LM" else "-"  # lies on least squares
    axes[0].plot(seconds, np.rad2deg(signals[:, 0]), line)
    axes[1].plot(seconds, clearance(signals), line, label=name)
axes[1].axhline(0.0, color="0.5", linewidth=0.8, linestyle="--")
axes[0].set(ylabel="left arm turned [deg]")
axes[1].set(ylabel="left elbow to capsule [cm]", xlabel="time [s]", xlim=(0, seconds[-1]))
for ax in axes:
    ax.spines[["top", "right"]].set_visible(False)
figure.legend(loc="outside right center", frameon=False, fontsize=9)

# %% [markdown]
# ## Gradients
#
# A problem is a pytree: change a leaf with `eqx.tree_at`, and differentiate the cost with respect to what you like,
# here the control points and the radius. At the minimum the former all but vanishes, so the latter says how the cost
# of the *fit* depends on the radius: compare the difference quotient of two fits.


# %%
def at(radius):
    return eqx.tree_at(lambda p: p.terms["keep_out"].args, problem, jnp.asarray(radius, float))


slopes = jax.jit(jax.grad(lambda points, radius: sum(at(radius).objective().costs(points)), argnums=(0, 1)))
for name, points in (("zero", mf.Correction.zero(controls).points), ("the minimum", fit.correction.points)):
    by_point, by_radius = slopes(points, 0.30)
    steepness = float(jnp.linalg.norm(jnp.concatenate(by_point)))
    print(f"at {name}: {steepness:.2g} per rad, {by_radius:.0f} per m of radius")
above, below = (mf.fit(at(radius), (block,)).history[0].cost_after for radius in (0.302, 0.298))
quotient = (above - below) / 0.004
print(f"two fits: {quotient:.0f} per m of radius")

# %% [markdown]
# ## What recompiles
#
# Arrays are data: weights, `args`, masks, scales, motion and body. Functions, counts and the solver's step limit are
# structure; a function defined again, as by running its cell again, is another one.

# %%
programs = []


def listen(event, duration_secs, **_):
    if event == "/jax/core/compile/backend_compile_duration":
        programs.append(duration_secs)


def solve(character=body, motion=base, term=variants["robust"][0], weights=None, moving=controls, free=block):
    mf.fit(mf.Problem(character, motion, {"keep_out": term, **quiet}, moving, weights), (free,))


shorter = tuple(eqx.tree_at(lambda c: c.basis, c, c.basis[np.arange(60)]) for c in controls)
cases = {
    "another weight": {"weights": {"effort": 3.0}},
    "another radius and c": {"term": mf.Robust(mf.Custom(keep_out, 0.25, reach=0), 2.0)},
    "another body": {"character": reference, "motion": mf.onto(clip, reference.skeleton)},
    "function defined again": {"term": mf.Robust(mf.Custom(lambda kin, radius: keep_out(kin, radius), 0.30, reach=0))},
    "another max_steps": {"free": mf.Block("arms", block.controls, max_steps=79)},
    "another length": {"motion": base[:60], "moving": shorter},
}
jax.monitoring.register_event_duration_secs_listener(listen)
compiled = {}
for name, changed in cases.items():
    programs.clear()
    solve(**changed)
    compiled[name] = len(programs)
    print(f"{name:<23} {compiled[name]} programs")
jax.monitoring.unregister_event_duration_listener(listen)

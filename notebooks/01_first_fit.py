# %% [markdown]
# # A first fit
#
# A walk, made for an average body, is put on a heavy one: the arms sink into the trunk, the thighs into each other.
# `mf.adapt` turns shoulders and hips by smooth signals until no part is deeper in another than on the body that the
# clip was made for, or by too little to count. Lengths are metres, angles radians, times seconds; y is up.

# %%
import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np

import motionfit as mf
from motionfit import view
from motionfit.metrics import TOLERANCE
from motionfit.samples import walk

clip = walk(cycles=2)  # or mf.load_motion("walk.bvh")
body = mf.load_character("builtin:heavy")  # or mf.load_character("body.glb")
reference = mf.load_character("builtin:average")
print(f"{clip.frame_count} frames at {clip.frame_rate:g} per second, {len(clip.skeleton.names)} joints")

# %% [markdown]
# ## Adapt
#
# The block `arms` takes the arms out of trunk and thighs, `legs` the legs out of each other. What the arms are free to do are three control signals
# per shoulder, what the legs are free to do two for both hips: B-splines in time.

# %%
fit = mf.adapt(clip, body, reference=reference, blocks=("arms", "legs"))
print(fit.status)
for name, moved in fit.report()["controls"].items():
    mean, most = (np.rad2deg(moved[key]) for key in ("mean_rad", "max_rad"))
    print(f"{name:<18} {mean:5.1f} deg in the mean, {most:5.1f} at most")

# %% [markdown]
# ## Depth over time
#
# `fit.details` holds the excess per frame and pair of parts: how much deeper the parts are in each other than on the
# reference in the same frame. Up to 1 cm (dashed) passes for no violation. These are depths on the volumes that the
# solver sees, at the frames that it sees.

# %%
BEFORE, AFTER = "#cc2222", "#1b6e3c"
before, after = (np.maximum(fit.details[f"excess_{when}_m"], 0.0) for when in ("before", "after"))
seconds = fit.details["frames"] * float(clip.dt)
shown = np.flatnonzero(before.max(axis=0) > TOLERANCE)

figure, axes = plt.subplots(1, len(shown), figsize=(2.6 * len(shown), 2.6), sharey=True, constrained_layout=True)
for ax, k in zip(axes, shown, strict=True):
    ax.fill_between(seconds, 100 * before[:, k], color=BEFORE, alpha=0.15, linewidth=0)
    ax.plot(seconds, 100 * before[:, k], color=BEFORE, label="before")
    ax.plot(seconds, 100 * after[:, k], color=AFTER, label="after")
    ax.axhline(100 * TOLERANCE, color="0.5", linewidth=0.8, linestyle="--")
    ax.set_title(fit.details["pairs"][k].replace("_", " ").replace("/", "\nin "), fontsize=9)
    ax.set_xlabel("time [s]")
    ax.spines[["top", "right"]].set_visible(False)
axes[0].set(ylabel="excess depth [cm]", ylim=(0, None))
axes[0].legend(frameon=False, fontsize=8)

# %% [markdown]
# ## The body
#
# The worst frame of each third of the clip, before and after. `view.report_picture` writes a larger picture of the
# same kind to a file.

# %%
thirds = np.array_split(np.arange(len(before)), 3)
moments = [int(fit.details["frames"][third[before[third].max(axis=1).argmax()]]) for third in thirds]
figure, axes = plt.subplots(1, 2, figsize=(12, 4.4), sharex=True, sharey=True, constrained_layout=True)
for ax, (name, motion) in zip(axes, (("before", fit.base), ("after", fit.motion)), strict=True):
    here = np.asarray(motion.root)[moments, None] * [1, 0, 1]
    for place, vertices in enumerate(mf.metrics.posed_vertices(body, motion[np.array(moments)]) - here):
        view.draw_body(ax, vertices, np.asarray(body.skin.faces), yaw=0.3, shift=1.2 * place)
        ax.text(1.2 * place, -0.12, f"{moments[place] * float(clip.dt):.2f} s", ha="center", fontsize=9)
    ax.set_title(name)
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.axis("off")

# %% [markdown]
# ## The correction is a pytree
#
# What was solved for are the control points; the motion is a function of them. So they can be scaled, averaged or
# differentiated like any pytree, and applied again without solving. Half of the correction, on the skinned mesh
# itself (every fourth frame, by generalised winding numbers), leaves part of the violation:

# %%
print(f"{sum(p.size for p in jax.tree.leaves(fit.correction.points))} control points [rad]")
half = eqx.tree_at(lambda c: c.points, fit.correction, jax.tree.map(lambda p: 0.5 * p, fit.correction.points))

own = mf.metrics.skin_depths(reference, clip, step=4).depth
motions = {"before": fit.base, "half": half.apply(fit.base), "after": fit.motion}
on_skin = {name: mf.metrics.skin_depths(body, motion, step=4).depth - own for name, motion in motions.items()}
for name, excess in on_skin.items():
    print(f"{name:<7} excess on the skin {100 * excess.max():4.1f} cm at worst, "
          f"over 1 cm in {(excess > TOLERANCE).any(axis=1).mean():4.0%} of the frames")  # fmt: skip

# %% [markdown]
# ## Save
#
# A `.glb` holds the skinned, animated character; the correction is a small file of its own, and gives the same
# rotations bit for bit.

# %%
mf.save("adapted.glb", fit.motion, body)
fit.correction.save("correction.npz")
again = mf.load_correction("correction.npz").apply(fit.base)
print("same rotations:", np.array_equal(again.rotations, fit.motion.rotations))

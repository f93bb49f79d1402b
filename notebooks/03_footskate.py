# %% [markdown]
# # Footskate
#
# A walk put on longer legs keeps its joint angles and a root path in proportion; its planted feet slide all the same.
# Three methods make them hold still: by the root alone, by the legs, or by heel and toe plants with prioritized
# inverse kinematics. Lengths are metres, times seconds; y is up.

# %%
import pathlib
import time

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection
from scipy.spatial import ConvexHull

import motionfit as mf
from motionfit.metrics import derivative_ratio, joint_angles
from motionfit.samples import walk

clip = walk(cycles=2)
body = mf.shape.scale_skeleton(mf.load_character("builtin:average"), {"inside_leg": 1.2})
base = mf.onto(clip, body.skeleton)  # what the methods do themselves to a clip on another skeleton
dt, seconds = float(base.dt), np.arange(base.frame_count) * float(base.dt)
print(f"{base.frame_count} frames at {base.frame_rate:g} per second")

# %% [markdown]
# ## When a foot is down
#
# `detect_footplants` says per frame which foot is down and on which vertex of the mesh, how sure it is, and which of
# two feet carries; the floor is fitted to the contacts. Below, the lowest point of each sole over that floor (dashed),
# and the frames in which the foot is down (bars). In this clip the toes dip under the floor as they swing through.

# %%
plants = mf.detect_footplants(base, body)
print({str(name): int((plants.labels == name).sum()) for name in np.unique(plants.labels)}, "frames")
print("floor at", f"{100 * plants.floor.height:.2f} cm, tilted by {np.rad2deg(plants.floor.tilt):.2f} deg")

sole = mf.feet.find_sole(body)
heights = plants.floor.above(mf.feet.sole_paths(sole, base))  # [m] of every sole vertex
figure, ax = plt.subplots(figsize=(9, 2.8), constrained_layout=True)
for foot, (name, color) in enumerate((("left", "#4477aa"), ("right", "#cc6677"))):
    ax.plot(seconds, 100 * heights[:, sole.of(foot)].min(axis=1), color=color, label=name)
    spans = [(p.start * dt, (p.end - p.start + 1) * dt) for p in plants.plants if p.foot == name]
    ax.broken_barh(spans, (-5.0 - 1.0 * foot, 0.7), color=color)
ax.set(xlabel="time [s]", ylabel="lowest point of the sole [cm]", xlim=(0, seconds[-1]))
ax.axhline(0.0, color="0.5", linewidth=0.8, linestyle="--")
ax.spines[["top", "right"]].set_visible(False)
ax.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 0.98), ncols=2)

# %% [markdown]
# ## Three methods
#
# `root` moves the root and leaves all rotations as they are (the very same array); `leg-ik` also bends the legs, so
# that both feet can stand at once; `adaptive` then also holds ankle and toe joints where thresholds that adapt to the
# clip say that they rest. The table gives what the carrying foot slides in all, by the plants found above, before and
# after; how far the root went; and the price: the largest turn of a joint, and the jerk of the joints over that of the
# clip.

# %%
fits, slides = {}, {"before": mf.feet.measure_feet(body, base, plants)["slide_path_m"]}
print(f"{'':<9} {'slides':>14} {'root moved':>11} {'joint turned':>13} {'jerk':>5} {'time':>8}")
for method in mf.feet.METHODS:
    started = time.perf_counter()
    fit = fits[method] = mf.remove_footskate(clip, body, method)
    took = time.perf_counter() - started
    slides[method] = mf.feet.measure_feet(body, fit.motion, plants)["slide_path_m"]
    root = np.linalg.norm(np.asarray(fit.motion.root) - np.asarray(fit.base.root), axis=1).max()
    turned = np.rad2deg(joint_angles(fit.motion, fit.base).max())
    print(f"{method:<9} {100 * slides['before']:4.1f} -> {100 * slides[method]:3.1f} cm "
          f"{100 * root:8.1f} cm {turned:9.1f} deg {derivative_ratio(fit.motion, fit.base, 3):5.2f} {1000 * took:5.0f} ms")  # fmt: skip
print("root: the same rotations:", fits["root"].motion.rotations is fits["root"].base.rotations)

# %% [markdown]
# ## Footprints
#
# The soles on the ground seen from above while they are down, ten prints per second, on the same plants: a foot that
# slides smears its print. The line is the root's path.

# %%
motions = {"before": base, **{method: fit.motion for method, fit in fits.items()}}
figure, axes = plt.subplots(len(motions), 1, figsize=(10, 4.8), sharex=True, sharey=True, constrained_layout=True)
for ax, (name, motion) in zip(axes, motions.items(), strict=True):
    ground = mf.feet.sole_paths(sole, motion)[:, :, [2, 0]]  # the walk goes along z
    prints = []
    for foot in (0, 1):
        for frame in np.flatnonzero(plants.planted[:, foot])[::6]:
            points = ground[frame, sole.of(foot)]
            prints.append(points[ConvexHull(points).vertices])
    color = "#3a8f4f" if name == "before" else "#2b5fb4"
    ax.add_collection(PolyCollection(prints, facecolors=color, edgecolors="k", linewidths=0.4, alpha=0.25))
    ax.plot(np.asarray(motion.root)[:, 2], np.asarray(motion.root)[:, 0], color="0.4", linewidth=1)
    ax.set_ylabel(name, rotation=0, ha="right", va="center")
    ax.set(aspect="equal", yticks=[])
    ax.spines[["top", "right", "left"]].set_visible(False)
axes[-1].set_xlabel("way [m]")

# %% [markdown]
# ## Labels by hand
#
# Footplants are intervals in a CSV file, to be corrected by hand; frames, or seconds with a decimal point. With the
# intervals as they were found the result stays as it was, up to the choice of the vertices that the file leaves open.

# %%
plants.save("plants.csv")
print(*pathlib.Path("plants.csv").read_text().splitlines()[:4], sep="\n")
labelled = mf.remove_footskate(clip, body, labels="plants.csv")
apart = np.abs(np.asarray(labelled.motion.root) - np.asarray(fits["root"].motion.root)).max()
print(f"{labelled.status}; at most {1000 * apart:.1f} mm from the root path above")

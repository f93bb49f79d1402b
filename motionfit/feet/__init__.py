"""Feet on the ground: the floor, the sole, when a foot is down, and how to make it hold still.

    plants = mf.detect_footplants(clip, body)          # which foot, which vertex, how sure; flight and both feet too
    clean = mf.remove_footskate(clip, body)            # clean.motion: no joint is turned, only the root moves

A foot is labelled as down where some low part of its sole is still and near the floor; the floor is a plane fitted to
the contacts, speeds are measured on a root path in proportion to the legs, and blinks are left out by a two-state
path of most evidence. So no kind of motion has to be named, and flight and double support come out by themselves.
`fixed_thresholds`, `dot_product` and `find_constraints` are the labellings of others, to compare with.

The sources are Lyard & Magnenat Thalmann 2007 with chapter 3 of Lyard's thesis (2008), and Glardon, Boulic &
Thalmann 2006.
"""

from motionfit.feet._classics import dot_product, fixed_thresholds
from motionfit.feet._cycles import Constraint, adaptive_threshold, find_constraints
from motionfit.feet._detect import Evidence, detect, gather, least_moving
from motionfit.feet._drift import keep_heights, keep_steps, stop_drift
from motionfit.feet._enforce import effector_path
from motionfit.feet._floor import Floor, fit_floor
from motionfit.feet._follow import follow_feet
from motionfit.feet._leg import hip_from_foot, hold_feet
from motionfit.feet._plants import Footplants, Plant, load_labels, save_labels
from motionfit.feet._remove import METHODS, FootFit, measure_feet
from motionfit.feet._root import frame_heights, horizontal_path, root_steps, scaled_heights, vertical_scale
from motionfit.feet._sole import Sole, find_sole, rows_of, sole_paths
from motionfit.feet._transfer import catmull_rom, cubic_roots, place_at, transfer_instant

__all__ = [
    "Constraint", "Evidence", "Floor", "FootFit", "Footplants", "METHODS", "Plant", "Sole", "adaptive_threshold",
    "catmull_rom", "cubic_roots", "detect", "dot_product", "effector_path", "find_constraints", "find_sole",
    "fit_floor", "fixed_thresholds", "follow_feet", "frame_heights", "gather", "hip_from_foot", "hold_feet", "horizontal_path",
    "keep_heights", "keep_steps", "least_moving", "load_labels", "measure_feet", "place_at", "root_steps", "rows_of", "save_labels", "scaled_heights",
    "sole_paths", "stop_drift", "transfer_instant", "vertical_scale",
]  # fmt: skip

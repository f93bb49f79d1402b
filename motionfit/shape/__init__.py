"""Body shape: volumes fitted to the skin, their distances, girth, and the built-in bodies."""

from motionfit.shape.distance import capsule_depth, cylinder_depth, segment_distance
from motionfit.shape.growth import grow, parse_girth
from motionfit.shape.pairs import PAIRS, Pair
from motionfit.shape.field import DepthField, Probes, fit_field, sample_probes
from motionfit.shape.volumes import Volumes, allocate_vertices, fit_volumes

__all__ = [
    "DepthField", "PAIRS", "Pair", "Probes", "Volumes", "allocate_vertices", "capsule_depth", "cylinder_depth",
    "fit_field", "fit_volumes", "grow", "parse_girth", "sample_probes", "segment_distance",
]  # fmt: skip

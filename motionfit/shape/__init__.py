"""Body shape: volumes fitted to the skin, their distances and masses, girth and lengths, and the built-in bodies."""

from motionfit.shape.distance import capsule_depth, cylinder_depth, segment_distance
from motionfit.shape.field import DepthField, fit_field
from motionfit.shape.growth import grow, parse_girth
from motionfit.shape.mass import Masses, anthropometric_masses, mass_volumes, mesh_masses, volume_masses
from motionfit.shape.pairs import PAIRS, Pair
from motionfit.shape.probes import Probes, make_probes
from motionfit.shape.scaling import scale_character, scale_root, scale_skeleton
from motionfit.shape.volumes import Volumes, allocate_vertices, fit_volumes

__all__ = [
    "DepthField", "PAIRS", "Masses", "Pair", "Probes", "Volumes", "allocate_vertices", "anthropometric_masses",
    "capsule_depth", "cylinder_depth", "fit_field", "fit_volumes", "grow", "make_probes", "mass_volumes",
    "mesh_masses", "parse_girth", "scale_character", "scale_root", "scale_skeleton", "segment_distance",
    "volume_masses",
]  # fmt: skip

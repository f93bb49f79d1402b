"""Body shape: volumes fitted to the skin, their distances and masses, girth and lengths, and the built-in bodies."""

from motionfit.shape.distance import capsule_depth, cylinder_depth, segment_distance
from motionfit.shape.growth import grow, parse_girth
from motionfit.shape.mass import Masses, anthropometric_masses, mass_volumes, mesh_masses, volume_masses
from motionfit.shape.pairs import PAIRS, Pair
from motionfit.shape.scaling import scale_character, scale_root, scale_skeleton
from motionfit.shape.volumes import Probes, Section, Volumes, allocate_vertices, fit_section, fit_volumes, sample_probes

__all__ = [
    "PAIRS", "Masses", "Pair", "Probes", "Section", "Volumes", "allocate_vertices", "anthropometric_masses",
    "capsule_depth", "cylinder_depth", "fit_section", "fit_volumes", "grow", "mass_volumes", "mesh_masses",
    "parse_girth", "sample_probes", "scale_character", "scale_root", "scale_skeleton", "segment_distance",
    "volume_masses",
]  # fmt: skip

"""Recipes that build a Problem and fit it. `motionfit.adapt(...)` itself runs the whole procedure."""

from motionfit.adapt._clearance import OBJECTIVES, build_clearance, volume_depths
from motionfit.adapt._pipeline import BLOCKS, adapt

__all__ = ["BLOCKS", "OBJECTIVES", "adapt", "build_clearance", "volume_depths"]

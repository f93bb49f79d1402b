"""Recipes that build a Problem and fit it. The module can be called: `motionfit.adapt(...)` runs the whole procedure."""

import sys
import types

from motionfit.adapt._balance import balance
from motionfit.adapt._clearance import OBJECTIVES, build_clearance, volume_depths
from motionfit.adapt._collisions import collisions
from motionfit.adapt._controls import Turn
from motionfit.adapt._feet import footskate
from motionfit.adapt._forearm import forearm, multi_start
from motionfit.adapt._groups import GROUPS, Group, Sphere
from motionfit.adapt._limbs import limbs
from motionfit.adapt._limits import reference_depths
from motionfit.adapt._many import adapt_many
from motionfit.adapt._per_frame import per_frame_ik, smoothed_corrections
from motionfit.adapt._procedure import BLOCKS, DEFAULT, adapt, arms, legs
from motionfit.adapt._sensitivity import girth_derivative, predict
from motionfit.adapt._standing import measure_standing, source_stance

__all__ = [
    "BLOCKS", "DEFAULT", "GROUPS", "Group", "OBJECTIVES", "Sphere", "Turn", "adapt", "adapt_many", "arms", "balance",
    "build_clearance", "collisions", "footskate", "forearm", "girth_derivative", "legs", "limbs", "measure_standing",
    "multi_start", "per_frame_ik", "predict", "reference_depths", "smoothed_corrections", "source_stance",
    "volume_depths",
]  # fmt: skip


class _CallableModule(types.ModuleType):
    """`motionfit.adapt` is both the verb, mf.adapt(clip, body), and the folder of its recipes, mf.adapt.arms."""

    def __call__(self, *args, **kwargs):
        return adapt(*args, **kwargs)


sys.modules[__name__].__class__ = _CallableModule

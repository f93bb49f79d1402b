"""What `motionfit.adapt` is to a type checker: a module that can be called. Never imported when the program runs."""

from types import ModuleType

import motionfit.adapt as recipes


class Adapt(ModuleType):
    """The verb, `mf.adapt(clip, body)`, with the recipes of its folder."""

    __call__ = staticmethod(recipes.adapt)

    BLOCKS, DEFAULT, GROUPS, OBJECTIVES = recipes.BLOCKS, recipes.DEFAULT, recipes.GROUPS, recipes.OBJECTIVES
    Group, Sphere, Turn = recipes.Group, recipes.Sphere, recipes.Turn
    adapt = staticmethod(recipes.adapt)
    adapt_many = staticmethod(recipes.adapt_many)
    arms = staticmethod(recipes.arms)
    balance = staticmethod(recipes.balance)
    build_clearance = staticmethod(recipes.build_clearance)
    collisions = staticmethod(recipes.collisions)
    footskate = staticmethod(recipes.footskate)
    forearm = staticmethod(recipes.forearm)
    legs = staticmethod(recipes.legs)
    limbs = staticmethod(recipes.limbs)
    measure_standing = staticmethod(recipes.measure_standing)
    multi_start = staticmethod(recipes.multi_start)
    per_frame_ik = staticmethod(recipes.per_frame_ik)
    reference_depths = staticmethod(recipes.reference_depths)
    smoothed_corrections = staticmethod(recipes.smoothed_corrections)
    source_stance = staticmethod(recipes.source_stance)
    volume_depths = staticmethod(recipes.volume_depths)

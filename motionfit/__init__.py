"""motionfit adapts a motion clip to the shape of a character, with exact gradients in JAX.

import motionfit as mf

fit = mf.adapt(mf.load_motion("walk.bvh"), mf.load_character("heavy.glb"))
mf.save("adapted.glb", fit.motion, mf.load_character("heavy.glb"))
"""

__version__ = "0.1.0"

from typing import TYPE_CHECKING

from motionfit import balance, dynamics, feet, ik, metrics, shape, terms
from motionfit import rotation as rotation
from motionfit import splines as splines
from motionfit._character import Character as Character
from motionfit._control import Control as Control
from motionfit._control import Correction as Correction
from motionfit._control import Drive as Drive
from motionfit._control import load_correction as load_correction
from motionfit._fit import Block as Block
from motionfit._fit import Fit as Fit
from motionfit._fit import fit as fit
from motionfit._motion import Kinematics as Kinematics
from motionfit._motion import Motion as Motion
from motionfit._motion import forward_kinematics as forward_kinematics
from motionfit._motion import resample as resample
from motionfit._onto import onto as onto
from motionfit._problem import Custom as Custom
from motionfit._problem import During as During
from motionfit._problem import Energy as Energy
from motionfit._problem import Problem as Problem
from motionfit._problem import Robust as Robust
from motionfit._problem import Term as Term
from motionfit._skeleton import Skeleton as Skeleton
from motionfit._skinning import Skin as Skin
from motionfit._skinning import skin as skin
from motionfit._traces import keep_programs as keep_programs
from motionfit._types import InputError as InputError
from motionfit.adapt._many import adapt_many as adapt_many
from motionfit.feet._remove import detect_footplants as detect_footplants
from motionfit.feet._remove import remove_footskate as remove_footskate
from motionfit.io import load_character as load_character
from motionfit.io import load_motion as load_motion
from motionfit.io import save as save
from motionfit.metrics import measure as measure

if TYPE_CHECKING:  # adapt is a module that can be called, which type checkers cannot know
    from motionfit.adapt._verb import Adapt

    adapt: Adapt
else:
    from motionfit import adapt

__all__ = [
    "Block", "Character", "Control", "Correction", "Custom", "Drive", "During", "Energy", "Fit", "InputError",
    "Kinematics", "Motion", "Problem", "Robust", "Skeleton", "Skin", "Term", "adapt", "adapt_many", "balance", "detect_footplants",
    "dynamics", "feet", "fit", "forward_kinematics", "ik", "keep_programs", "load_character", "load_correction", "load_motion", "measure",
    "metrics", "onto", "remove_footskate", "resample", "rotation", "save", "shape", "skin", "splines", "terms",
]  # fmt: skip

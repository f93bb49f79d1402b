"""motionfit adapts a motion clip to the shape of a character, with exact gradients in JAX.

import motionfit as mf

fit = mf.adapt(mf.load_motion("walk.bvh"), mf.load_character("heavy.glb"))
mf.save("adapted.glb", fit.motion, mf.load_character("heavy.glb"))
"""

from lazy_loader import attach_stub

__version__ = "0.1.0"

# what is public stands in __init__.pyi, and is imported where it is first used: all of it, with SciPy, takes a second
__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)

# The public names of motionfit and where they are: lazy_loader imports them from there when they are first used.
import typing

import motionfit.adapt._verb as _verb

__version__: str
__all__: list[str]

from . import balance as balance
from . import dynamics as dynamics
from . import feet as feet
from . import ik as ik
from . import metrics as metrics
from . import rotation as rotation
from . import shape as shape
from . import splines as splines
from . import terms as terms
from ._character import Character as Character
from ._control import Control as Control
from ._control import Correction as Correction
from ._control import Drive as Drive
from ._control import load_correction as load_correction
from ._fit import Fit as Fit
from ._fit import fit as fit
from ._motion import Kinematics as Kinematics
from ._motion import Motion as Motion
from ._motion import forward_kinematics as forward_kinematics
from ._motion import resample as resample
from ._onto import onto as onto
from ._problem import Custom as Custom
from ._problem import During as During
from ._problem import Energy as Energy
from ._problem import Problem as Problem
from ._problem import Robust as Robust
from ._problem import Term as Term
from ._skeleton import Skeleton as Skeleton
from ._skinning import Skin as Skin
from ._skinning import skin as skin
from ._solve import Block as Block
from ._traces import keep_programs as keep_programs
from ._types import InputError as InputError
from .adapt._many import adapt_many as adapt_many
from .feet._remove import detect_footplants as detect_footplants
from .feet._remove import remove_footskate as remove_footskate
from .io import load_character as load_character
from .io import load_motion as load_motion
from .io import save as save
from .metrics import measure as measure

adapt: _verb.Adapt  # to a type checker, which cannot know that the module can be called
if not typing.TYPE_CHECKING:
    from . import adapt as adapt

"""The model: a rover, a terrain and a list of effects; `file` keeps it on disk, `describe` prints it."""

from lunar_mjx.model.model import DEFAULT_TERRAIN as DEFAULT_TERRAIN
from lunar_mjx.model.model import LUNAR_GRAVITY as LUNAR_GRAVITY
from lunar_mjx.model.model import ZERO_CELSIUS as ZERO_CELSIUS
from lunar_mjx.model.model import Model as Model
from lunar_mjx.model.model import Value as Value
from lunar_mjx.model.model import check_effects as check_effects
from lunar_mjx.model.model import make_model as make_model
from lunar_mjx.model.model import preset_values as preset_values
from lunar_mjx.model.model import rover_motors as rover_motors
from lunar_mjx.model.model import settled as settled

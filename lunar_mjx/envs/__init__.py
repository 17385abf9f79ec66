"""Environments: the navigation task over thousands of rovers, a physics-free one for tests, and adapters."""

from lunar_mjx.envs.core import Environment as Environment
from lunar_mjx.envs.core import State as State
from lunar_mjx.envs.core import split_keys as split_keys
from lunar_mjx.envs.navigation.config import TASKS as TASKS
from lunar_mjx.envs.navigation.config import UNSAID as UNSAID
from lunar_mjx.envs.navigation.config import NavigationConfig as NavigationConfig
from lunar_mjx.envs.navigation.env import NavigationEnv as NavigationEnv
from lunar_mjx.envs.navigation.env import make_navigation as make_navigation
from lunar_mjx.envs.navigation.randomise import Range as Range
from lunar_mjx.envs.point import PointEnv as PointEnv
from lunar_mjx.envs.registry import make as make
from lunar_mjx.envs.registry import register as register
from lunar_mjx.envs.scripted import make_agent as make_agent

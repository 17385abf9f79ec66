"""The Sun over a terrain: where it stands, how much of it the horizon leaves."""

from lunar_mjx.terrain.sky.horizon import Horizon as Horizon
from lunar_mjx.terrain.sky.sun import Sun as Sun
from lunar_mjx.terrain.sky.sun import Sunlight as Sunlight
from lunar_mjx.terrain.sky.sun import fixed_sun as fixed_sun

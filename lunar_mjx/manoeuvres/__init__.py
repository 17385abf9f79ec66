"""Canned manoeuvres that tell effects apart: ready to run on a rover or in the simulator, one TOML file each."""

from lunar_mjx.manoeuvres.manoeuvre import MANOEUVRES as MANOEUVRES
from lunar_mjx.manoeuvres.manoeuvre import Manoeuvre as Manoeuvre
from lunar_mjx.manoeuvres.manoeuvre import Segment as Segment
from lunar_mjx.manoeuvres.manoeuvre import commands as commands
from lunar_mjx.manoeuvres.manoeuvre import load_manoeuvre as load_manoeuvre
from lunar_mjx.manoeuvres.manoeuvre import with_arrangement as with_arrangement
from lunar_mjx.manoeuvres.stand import stand as stand

"""Rocks as obstacles: spheres and ellipsoids partly buried, and the grid that finds them."""

from lunar_mjx.terrain.rocks.form import Form as Form
from lunar_mjx.terrain.rocks.form import forms_of as forms_of
from lunar_mjx.terrain.rocks.form import principal_axes as principal_axes
from lunar_mjx.terrain.rocks.lookup import CELL as CELL
from lunar_mjx.terrain.rocks.lookup import MOST_ELONGATED as MOST_ELONGATED
from lunar_mjx.terrain.rocks.lookup import REACH as REACH
from lunar_mjx.terrain.rocks.lookup import Rocks as Rocks
from lunar_mjx.terrain.rocks.lookup import build_ellipsoids as build_ellipsoids
from lunar_mjx.terrain.rocks.lookup import build_rocks as build_rocks
from lunar_mjx.terrain.rocks.lookup import clearance as clearance
from lunar_mjx.terrain.rocks.lookup import form_at as form_at
from lunar_mjx.terrain.rocks.lookup import nearest_rock as nearest_rock
from lunar_mjx.terrain.rocks.lookup import padded as padded
from lunar_mjx.terrain.rocks.lookup import semi_axes as semi_axes
from lunar_mjx.terrain.rocks.lookup import smallest_gap as smallest_gap
from lunar_mjx.terrain.rocks.lookup import with_forms as with_forms

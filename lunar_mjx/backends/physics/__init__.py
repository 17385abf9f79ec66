"""The forces and heat flows of a rover in plain NumPy, float64: written from the equations, for cross-validation.

Nothing here calls the JAX effects. Arrays have a leading axis of rovers: (rover, wheel), (rover, joint),
(rover, wheel, 3); SI units, temperatures in kelvin.
"""

from lunar_mjx.backends.physics.context import Context as Context
from lunar_mjx.backends.physics.forces import ForceModel as ForceModel
from lunar_mjx.backends.physics.ground import Ground as Ground
from lunar_mjx.backends.physics.parameters import SUPPORTED as SUPPORTED
from lunar_mjx.backends.physics.parameters import Numbers as Numbers
from lunar_mjx.backends.physics.parameters import read_numbers as read_numbers

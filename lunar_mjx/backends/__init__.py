"""The same model on every engine behind one small interface, and the parity between them."""

from lunar_mjx.backends.base import Backend as Backend
from lunar_mjx.backends.base import BackendState as BackendState
from lunar_mjx.backends.hooks import POINTS as POINTS
from lunar_mjx.backends.hooks import Hook as Hook
from lunar_mjx.backends.native import NativeBackend as NativeBackend

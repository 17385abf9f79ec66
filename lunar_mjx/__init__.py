"""lunar-mjx: lunar rovers on MuJoCo MJX, held against measurements."""

__version__ = "0.1.0"

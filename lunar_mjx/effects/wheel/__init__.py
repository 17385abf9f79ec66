"""Effects of wheels on soil and rock (ports `wheel_normal` and `wheel_shear`)."""

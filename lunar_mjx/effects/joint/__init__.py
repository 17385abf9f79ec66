"""Effects of motors and joints (ports `command` and `motor_torque`)."""

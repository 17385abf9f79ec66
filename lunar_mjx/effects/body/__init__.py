"""Effects of the rover's geometry and of loads on its bodies (ports `geometry` and `body_wrench`)."""

"""Effects of the ground's parameters (port `soil`)."""

"""Effects of the motors' temperatures (port `heat`)."""

"""Effects of what sensors report (port `sensor`)."""

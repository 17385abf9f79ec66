"""Effects of electric power (port `power`), and the chassis that its losses warm."""

"""Logs recorded from the simulator, with the instruments that would have measured them."""

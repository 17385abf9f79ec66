"""Rovers simulated like those of the logs: many hypotheses in one compiled batch."""

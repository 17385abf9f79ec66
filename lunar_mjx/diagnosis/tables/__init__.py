"""Steady-state tables of single-wheel test beds as a problem of inference."""

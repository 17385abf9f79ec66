"""Refits of a rover's model against drives: priors, errors of measurements, derivatives, descents."""

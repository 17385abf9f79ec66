"""Hypotheses about what is missing, weighed against each other by their evidence."""

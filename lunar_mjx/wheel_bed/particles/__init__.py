"""A single-wheel test bed of particles: sand by Newton's implicit material point method (extra `particles`)."""

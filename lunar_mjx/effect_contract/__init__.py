"""What every effect promises, and the checks of it (`lunar-mjx effect test`)."""

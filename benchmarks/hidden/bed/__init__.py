"""The single-wheel test bed of hidden effects: its equations, what is hidden in it, and the logs that it writes."""

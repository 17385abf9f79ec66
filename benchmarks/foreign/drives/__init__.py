"""Foreign campaigns of drives: rovers, their rollouts, what is hidden in them, and how the tool is asked about them."""

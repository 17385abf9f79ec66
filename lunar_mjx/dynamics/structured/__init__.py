"""The structured engine: a floating base with legs, solved without a general mass matrix."""

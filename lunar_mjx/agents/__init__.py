"""Reinforcement learning on the device: TD3, DDPG, SAC, PPO and distillation, over as many devices as there are."""

CHOOSING_SEED, FINAL_SEED = 12345, 54321
"""Seeds of the episodes by which a policy is chosen while it trains, and of those of its final score: others, since a
score by which something was chosen flatters it. Any two numbers would do."""
UNSEEN_PLACES = 7919
"""Added to the seed of a training's places for those of an evaluation: a prime, far from seeds counted up by hand."""

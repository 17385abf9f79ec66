"""SAC and PPO out of brax's own losses, distributions and schedules, in the shape that `Learner` trains."""

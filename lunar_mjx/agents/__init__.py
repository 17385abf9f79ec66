"""Off-policy reinforcement learning on the device: replay buffer, DDPG, TD3, training over many devices."""

"""Learning an excitation: environments, rewards, asymmetric PPO."""

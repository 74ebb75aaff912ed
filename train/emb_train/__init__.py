"""Learning an excitation: environments, rewards, asymmetric PPO, contextual evolution of references, evaluation."""

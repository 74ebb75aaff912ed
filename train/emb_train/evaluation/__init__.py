"""Evaluation of actors on brakes that they never saw, beside baselines without learning and the known optimum."""

"""Baselines without learning, evaluated behind the same shield as a learned excitation: what it has to beat."""

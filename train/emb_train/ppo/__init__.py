"""Asymmetric proximal policy optimisation (thesis Algorithm 1)."""

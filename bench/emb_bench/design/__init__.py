"""Optimal excitation for known parameters: the ruler that every policy is measured with."""

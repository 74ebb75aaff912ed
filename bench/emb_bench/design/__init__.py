"""Optimal excitation for known parameters: the optimum that policies are compared with."""

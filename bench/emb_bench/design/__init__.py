"""Optimal excitation for given parameters: the optimum that policies are compared with."""

"""Fisher information of an experiment, and the criteria computed from it."""

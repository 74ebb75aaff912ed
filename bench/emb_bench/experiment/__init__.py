"""The experiment in a log: applied currents and samples, and their simulation by a model."""

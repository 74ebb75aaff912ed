"""Learned excitation for a plant that is no brake: one interface, and what the learner needs behind it."""

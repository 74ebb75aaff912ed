"""Recordings that others made, read by a map file as experiments."""

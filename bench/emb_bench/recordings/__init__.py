"""Recordings that others made: read by a map file, and written as a run like ours as far as they go."""

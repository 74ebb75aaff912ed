"""Replay of a logged run through the same control loop."""

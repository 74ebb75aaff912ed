"""A kernel that has vcan, where the host has none."""

"""Drives that speak another protocol: mapping file, translation, second guard, and the node in between."""

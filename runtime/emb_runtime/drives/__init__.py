"""Drives that speak a protocol of their own: mapping file, translation, second guard, and the node in between."""

"""Adversarial searches in great numbers, each run by hand or at night: ``python -m tests.searches.NAME``."""

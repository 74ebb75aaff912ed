"""Verdict on estimates: uncertainty, several runs and models, drift."""

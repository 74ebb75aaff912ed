"""Excitations on the same brakes with the same noise, judged by the estimates: ``python -m studies.comparison``."""

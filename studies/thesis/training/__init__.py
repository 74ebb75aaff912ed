"""The thesis's trainings, tables and figures made again: ``python -m studies.thesis.training``."""

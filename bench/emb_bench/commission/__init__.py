"""Examination of the logs of a commissioning: what each step of it has found."""

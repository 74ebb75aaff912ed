"""Logs in the formats of other tools, and repair of damaged logs."""

"""The brake: its physics, its Fisher information, the simulated CAN node, and the reading of logs."""

"""One training: its configuration, checkpoints, validation and progress."""

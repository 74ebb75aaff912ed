"""A run shown while it goes on: its log is followed as it grows, served to viewers, or told line by line."""

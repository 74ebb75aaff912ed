"""A run shown while it goes on: its log is read as it grows, and served to browsers and viewers."""

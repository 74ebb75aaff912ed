"""Configuration: the bench file as checked records."""

"""Configuration: the bench file as checked records, plants, and timing budgets."""

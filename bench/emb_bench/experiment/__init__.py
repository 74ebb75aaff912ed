"""The experiment inside a log: which current acted when, what was measured, and what a model makes of it."""

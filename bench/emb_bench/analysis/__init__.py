"""From estimates to a verdict: model validation, uncertainty, drift, and the recommended experiment."""

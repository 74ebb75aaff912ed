"""Verdict on estimates: model validation, uncertainty, drift, and the recommended experiment."""

"""Commissioning of an unknown brake: from a data sheet's ranges to a bench file, step by step."""

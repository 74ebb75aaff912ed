"""The learning shield's argument, checked by machine: parts of the set (M), the two currencies (B and G)."""

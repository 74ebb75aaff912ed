"""The learning shield's argument, checked by machine: parts of the set (M), strips and ellipsoid (B)."""

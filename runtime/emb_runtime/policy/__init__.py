"""Policies: ONNX files checked against their contract, and their evaluation once per cycle."""

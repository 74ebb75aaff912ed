"""Export of a trained actor to one ONNX file with its contract, and the proof that both compute the same."""

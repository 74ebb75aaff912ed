"""``emb-run``: options, pre-flight, the run itself, and its summary."""

"""The command ``emb-train``."""

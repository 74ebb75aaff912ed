"""The commands ``emb-node``, ``emb-replay`` and ``emb-design``."""

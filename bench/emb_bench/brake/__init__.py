"""Brake models: equations as plain scalar functions, compiled for the batch by ``emb_bench.compiled``."""

"""Commissioning of an unknown brake: runs of ``emb-run``, from a data sheet's ranges to a bench file."""

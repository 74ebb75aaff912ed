"""One module for each experiment that ``emb-train --preset`` knows."""

"""Analysis figures of Guo (TU Darmstadt, 2024) and a check of what it prints: ``python -m studies.thesis``."""

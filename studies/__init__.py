"""Studies that nobody at a bench runs: what the thesis computed, and which excitation is worth what."""

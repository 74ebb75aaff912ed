"""Studies, not needed at a bench: the thesis reproduced, and excitations compared."""

"""Reference excitations and candidates: currents to compare a learned excitation with."""

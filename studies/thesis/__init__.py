"""The analysis figures of Guo (TU Darmstadt, 2024), computed anew, and whether what it prints about them follows."""

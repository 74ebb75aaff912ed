"""Everything that is installed on the bench computer: frames, 1 kHz loop, guard, recorder, policy."""

"""The computer: clocks, real-time settings, child processes, the terminal."""

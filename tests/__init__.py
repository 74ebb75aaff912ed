"""The tests calculate on one thread each, as the commands do: two workers with two threads each wait for each other."""

import os

for _library in ("OMP", "OPENBLAS", "MKL"):  # before numpy is imported
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

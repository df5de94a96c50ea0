"""Measured figures of the whole software: `python -m benchmarks --list`.

Everything is timed with one thread per process, as a flight computer would give it.
"""

import os

# Read once by the numerical libraries, when they are first imported.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ[_name] = "1"

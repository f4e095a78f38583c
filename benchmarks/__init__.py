"""Benchmarks; one thread each, also in the libraries that are loaded after this."""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # idle threads that wait for work count as CPU time

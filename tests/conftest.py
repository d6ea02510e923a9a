"""Two processes share the tests (pytest-xdist), and threads of the BLAS in each would only be in the way."""

import os

# Before NumPy loads its BLAS.
for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

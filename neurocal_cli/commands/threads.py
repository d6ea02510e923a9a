"""How many threads a command computes in."""

from __future__ import annotations

import os


def compute_in_one_thread() -> None:
    """Keep the linear algebra to one thread, for this process and those it starts.

    The matrices are small: threads cost three times the time they save, and their number would
    show in the last digits. It must be said before numpy is loaded; the user's own choice stands.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ.setdefault(name, "1")

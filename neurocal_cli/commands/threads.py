"""The number of threads of a command."""

from __future__ import annotations

import os


def compute_in_one_thread() -> None:
    """Limit the linear algebra to one thread, for this process and those it starts.

    The matrices are small: threads cost three times the time that they save, and their number would change
    the last digits. It must be set before numpy is loaded. The user's own setting takes precedence.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ.setdefault(name, "1")

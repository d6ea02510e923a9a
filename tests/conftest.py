"""For all tests: threads, examples that are the same in every run, and real data."""

import gc
import os
import signal

from hypothesis import HealthCheck, settings

# Two processes share the tests (pytest-xdist): threads of the BLAS in each would only be in each other's way.
# Before NumPy loads it.
for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

# Programs that tests start would compile the whole package each time.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# A shell starts what runs in the background with interrupts ignored, which programs started by tests inherit.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Only now, for it loads NumPy.
from support.real_data import real_files, zhang  # noqa: E402, F401

# What fails once has to fail again, and a busy computer is no failure.
settings.register_profile(
    "repeatable", derandomize=True, max_examples=50, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("repeatable")


def pytest_collection_finish() -> None:
    """Thousands of tests, which stay to the end, are not looked through for garbage again and again."""
    gc.collect()
    gc.freeze()

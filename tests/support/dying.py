"""Work whose process dies, for tests of the pool of processes."""

from __future__ import annotations

import os
import signal
from pathlib import Path


def die_once(place: str) -> str:
    """Kill this process, unless the file is there already; the work is its name."""
    path = Path(place)
    if not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return path.name


def die_if_bad(name: str) -> str:
    """Kill this process for a certain task."""
    if name == "bad":
        os.kill(os.getpid(), signal.SIGKILL)
    return name.upper()

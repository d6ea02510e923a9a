"""Names of temporary files, and the removal of those that a killed process left behind.

A name contains the computer and the process. Files of an ended process of this computer are removed by the
next process that writes into the same folder; all others are kept.
"""

from __future__ import annotations

import os
import platform
import re
from binascii import crc32
from contextlib import suppress

_NAME = r"\.neurocal-([0-9a-f]{8})-(\d{1,10})-[0-9a-f]{16}\.tmp"
_seen: set[str] = set()  # folders that this process has cleared


def temporary_name() -> str:
    """A name unique to this process."""
    return f".neurocal-{_computer()}-{os.getpid()}-{os.urandom(8).hex()}.tmp"


def remove_stale(folder: str) -> None:
    """Remove what killed processes left in a folder; once for each folder."""
    # On Windows no question to a process is harmless.
    if folder in _seen or os.name != "posix":
        return
    _seen.add(folder)
    with suppress(OSError):
        names = [name for name in os.listdir(folder or ".") if name.startswith(".neurocal-")]
        for name in names:
            match = re.fullmatch(_NAME, name)
            if match and match[1] == _computer() and not _runs(int(match[2])):
                with suppress(OSError):
                    os.unlink(os.path.join(folder, name))


def _computer() -> str:
    return f"{crc32(platform.node().encode()):08x}"


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)  # asks, and sends nothing
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # of another user
        return True
    return True

"""Name temporary files, and remove those that a killed process left behind.

A name contains the computer and the process that created the file. If that process of this computer has
ended, the next process that writes to the same folder removes the file. Other files are left alone.
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
    """Make a name that no other process chooses."""
    return f".neurocal-{_computer()}-{os.getpid()}-{os.urandom(8).hex()}.tmp"


def remove_stale(folder: str) -> None:
    """Remove the files that killed processes left in a folder, once per folder and process."""
    # On Windows, os.kill is no harmless test of a process.
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
        os.kill(pid, 0)  # only tests whether the process exists
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # a process of another user
        return True
    return True

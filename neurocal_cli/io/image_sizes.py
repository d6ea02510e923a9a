"""Sizes of images by the beginning of their files, for a look before the work."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator

_HEAD = 32  # bytes
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def image_sizes(paths: Iterable[str]) -> Iterator[tuple[int, int] | None]:
    """Width and height [px] as stored, None for standard input, other kinds of files and unreadable ones.

    Sorted, so that images turned by their EXIF orientation have one size: this serves to find different
    cameras, and decoding says the rest.
    """
    for path in paths:
        size = None if path == "-" else _size(path)
        yield None if size is None else (max(size), min(size))


def _size(path: str) -> tuple[int, int] | None:
    try:
        with open(path, "rb") as file:
            head = file.read(_HEAD)
            if head.startswith(_SIGNATURE) and len(head) >= 24:
                width, height = struct.unpack(">II", head[16:24])
                return width, height
            if not head.startswith(b"\xff\xd8"):
                return None
            file.seek(2)
            while True:
                mark, kind, length = struct.unpack(">BBH", file.read(4))
                if mark != 0xFF:
                    return None
                if kind in _FRAMES:
                    height, width = struct.unpack(">xHH", file.read(5))
                    return width, height
                file.seek(length - 2, 1)
    except (OSError, ValueError, struct.error):
        return None

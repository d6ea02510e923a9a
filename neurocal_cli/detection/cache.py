"""A folder that caches the outcomes of detection, so that a later run need not repeat it.

Each image has its own file, named after a hash of its bytes, the request, and neurocal's version. The file is
written at once, so that an interrupted run continues where it stopped.
"""

from __future__ import annotations

import hashlib
import json
import os
from base64 import b64decode, b64encode
from contextvars import Context
from typing import Any

import numpy as np

from neurocal_cli import __version__
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.detect import Detection
from neurocal_cli.detection.outcome import Outcome
from neurocal_cli.errors import NeurocalError
from neurocal_cli.files.files import read_bytes
from neurocal_cli.files.writing import write_whole

_FORMAT = 5  # raised when the same image gives other points than before
# Of a detection; its grids are not cached, which only its picture needs.
_FIELDS = ("ids", "world", "pixels", "covariance", "across", "image_size", "rejected", "warnings")


class DetectionCache:
    """A folder of cached outcomes, created if it does not exist.

    The text of the request differs if the requested detection differs.
    """

    def __init__(self, folder: str, request: str) -> None:
        self._folder, self._request = folder, f"{_FORMAT} {__version__} {request}".encode()

    def find(self, image: bytes) -> Outcome | None:
        """Find the outcome for an image, given the bytes of its file; None if it is not cached."""
        path = self._path(image)
        if not os.path.exists(path):
            return None
        try:
            tree = json.loads(read_bytes(path)[0])
            return Outcome(
                path="",
                detection=None if tree["detection"] is None else _detection(tree["detection"]),
                problem=str(tree["problem"]),
                notes=tuple(map(str, tree["notes"])),
                overlay=None if tree["overlay"] is None else b64decode(tree["overlay"]),
                shown=None if tree["shown"] is None else (int(tree["shown"][0]), int(tree["shown"][1])),
            )
        except (NeurocalError, ValueError, KeyError, TypeError, IndexError):  # damaged: detect again
            return None

    def store(self, image: bytes, outcome: Outcome) -> None:
        """Write an outcome at once, because the outputs that a command holds back are lost if it stops.

        Raises NeurocalError if the folder cannot be written to.
        """
        found, overlay = outcome.detection, outcome.overlay
        tree = {
            "detection": None if found is None else {name: getattr(found, name) for name in _FIELDS},
            "problem": outcome.problem,
            "notes": outcome.notes,
            "overlay": None if overlay is None else b64encode(overlay).decode(),
            "shown": outcome.shown,
        }
        os.makedirs(self._folder, exist_ok=True)
        text = json.dumps(tree, default=np.ndarray.tolist)
        Context().run(write_whole, self._path(image), text + "\n")

    def _path(self, image: bytes) -> str:
        return os.path.join(self._folder, f"{hashlib.sha256(self._request + image).hexdigest()}.json")


def _detection(tree: dict[str, Any]) -> Detection:
    ids = tuple(map(str, tree["ids"]))
    width, height = tree["image_size"]
    return Detection(
        ids=ids,
        world=_array(tree["world"], len(ids), 3),
        pixels=_array(tree["pixels"], len(ids), 2),
        covariance=_array(tree["covariance"], len(ids), 3),
        across=None if tree["across"] is None else _array(tree["across"], len(ids), 2),
        image_size=(int(width), int(height)),
        rejected=int(tree["rejected"]),
        warnings=tuple(map(str, tree["warnings"])),
    )


def _array(values: Any, rows: int, columns: int) -> Array:
    array = np.array(values, dtype=float)
    if array.shape != (rows, columns) or not np.isfinite(array).all():
        raise ValueError("a table of another size")
    return array

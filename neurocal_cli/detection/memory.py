"""Cache of detections in a folder, by the content of the images, so that a later run can reuse them.

Each image has its own file, named after the hash of its bytes, the detection options and neurocal's version.
It is written at once, so that an interrupted run can be resumed.
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
from neurocal_cli.detection.batch import Outcome
from neurocal_cli.detection.detect import Detection
from neurocal_cli.errors import NeurocalError
from neurocal_cli.geometry import Array
from neurocal_cli.io.files import read_bytes
from neurocal_cli.io.writing import write_whole

_FORMAT = 1


class Memory:
    """A folder of cached detections.

    Parameters
    ----------
    folder : str
        Created if it does not exist.
    asked : str
        The detection options as text; different options give different texts.
    """

    def __init__(self, folder: str, asked: str) -> None:
        self._folder, self._asked = folder, f"{_FORMAT} {__version__} {asked}".encode()

    def recall(self, image: bytes) -> Outcome | None:
        """The cached detection of an image, by the bytes of its file; None if there is none."""
        path = self._place(image)
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
        except (NeurocalError, ValueError, KeyError, TypeError, IndexError):  # damaged: look again
            return None

    def keep(self, image: bytes, outcome: Outcome) -> None:
        """Write a detection at once, so that it is not lost if the command is interrupted.

        Raises
        ------
        NeurocalError
            The folder cannot be written to.
        """
        found, overlay = outcome.detection, outcome.overlay
        tree = {
            "detection": None if found is None else _tree(found),
            "problem": outcome.problem,
            "notes": outcome.notes,
            "overlay": None if overlay is None else b64encode(overlay).decode(),
            "shown": outcome.shown,
        }
        os.makedirs(self._folder, exist_ok=True)
        Context().run(write_whole, self._place(image), json.dumps(tree) + "\n")

    def _place(self, image: bytes) -> str:
        return os.path.join(self._folder, f"{hashlib.sha256(self._asked + image).hexdigest()}.json")


def _tree(found: Detection) -> dict[str, Any]:
    return {
        "ids": found.ids,
        "world": found.world.tolist(),
        "pixels": found.pixels.tolist(),
        "covariance": found.covariance.tolist(),
        "across": None if found.across is None else found.across.tolist(),
        "image_size": found.image_size,
        "rejected": found.rejected,
        "warnings": found.warnings,
    }


def _detection(tree: dict[str, Any]) -> Detection:
    """A detection without its grids, which only its picture needs."""
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

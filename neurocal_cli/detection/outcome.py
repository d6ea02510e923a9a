"""What came of one image file."""

from __future__ import annotations

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.detection.detect import Detection


@frozen_dataclass(eq=False)
class Outcome:
    """Result of one image file: a detection, or a problem in one line."""

    path: str
    detection: Detection | None = None
    problem: str = ""  # empty if there is a detection
    notes: tuple[str, ...] = ()  # remarks for the user on the image and its detection
    overlay: bytes | None = None  # a PNG; images without the board have one, too
    # (cols, rows): number of inner vertices of another board in the image
    shown: tuple[int, int] | None = None

"""Choose frames of a video to measure: sharp ones that differ from each other.

Each short stretch of the video gives its sharpest frame. Frames much less sharp than the median of these are
dropped. The sharpest frame is chosen first, then repeatedly the one that differs most from all chosen so far,
until the next one would hardly differ. So a board that is held still gives one frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_STRETCH = 0.25  # seconds; even a shaking hand is still for a moment in it
_LONGEST = 60  # frames
_WIDTH = 640  # px; enough to measure sharpness, at less cost
_THUMB = (48, 36)  # px
_SHARP = 0.4  # least sharpness, relative to the median of the stretches
_DIFFERENT = 6.0  # DN rms between thumbnails; the noise of a still camera gives 1 after averaging


@frozen_dataclass(eq=False)
class _Frame:
    """A frame of a video."""

    number: int
    sharpness: float
    thumb: Array


def choose_frames(frames: Iterable[NDArray[np.uint8]], most: int, rate: float = 30.0) -> list[int]:
    """Choose at most `most` of the grey frames of a video by their numbers, in the order of the video.

    `rate` is in frames per second. In a slow video, such as one of single photographs, every frame is a
    stretch.
    """
    length = int(np.clip(round(_STRETCH * rate), 1, _LONGEST))
    seen = (_seen(number, grey) for number, grey in enumerate(frames))
    stretches = groupby(seen, key=lambda frame: frame.number // length)
    best = [max(stretch, key=lambda frame: frame.sharpness) for _, stretch in stretches]
    if not best:
        return []
    least = _SHARP * np.median([frame.sharpness for frame in best])
    sharp = [frame for frame in best if frame.sharpness >= least]
    thumbs = np.stack([frame.thumb.ravel() for frame in sharp])
    chosen = [int(np.argmax([frame.sharpness for frame in sharp]))]
    distance = _distance(thumbs, thumbs[chosen[0]])
    while len(chosen) < most and distance.max() > _DIFFERENT:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, _distance(thumbs, thumbs[chosen[-1]]))
    return sorted(sharp[k].number for k in chosen)


def _seen(number: int, grey: NDArray[np.uint8]) -> _Frame:
    height, width = grey.shape
    factor = min(1.0, _WIDTH / width)
    small = cv2.resize(grey, (round(factor * width), round(factor * height)), interpolation=cv2.INTER_AREA)
    thumb = cv2.resize(small, _THUMB, interpolation=cv2.INTER_AREA).astype(float)
    return _Frame(number, float(cv2.Laplacian(small, cv2.CV_32F).var()), thumb)


def _distance(thumbs: Array, one: Array) -> Array:
    return np.asarray(np.sqrt(((thumbs - one) ** 2).mean(axis=1)))

"""Frames of videos as grey images."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextvars import Context

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import FormatError
from neurocal_cli.files.failures import one_line, reading_failures
from neurocal_cli.files.image_headers import is_video_header
from neurocal_cli.files.images import captured_stderr, encode_png
from neurocal_cli.files.writing import write_whole

_HEAD = 16  # bytes that identify the kind of file
_USUAL, _FASTEST = 30.0, 1e4  # frames per second


def is_video(path: str) -> bool:
    """Whether a file begins like a video; False for stdin and for what is not a file."""
    if path == "-" or not os.path.isfile(path):
        return False
    with reading_failures(one_line(path)), open(path, "rb") as file:
        return is_video_header(file.read(_HEAD))


def video_frames(path: str) -> Iterator[NDArray[np.uint8]]:
    """Iterate over the frames of a video as grey images."""
    with captured_stderr():
        capture = cv2.VideoCapture(path)
    count = 0
    try:
        while True:
            with captured_stderr():
                there, frame = capture.read()
            if not there:
                break
            count += 1
            grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            yield np.asarray(grey, dtype=np.uint8)
    finally:
        capture.release()
    if not count:
        raise FormatError(
            "is a video that cannot be decoded here, as it is damaged or OpenCV has no codec for it; extract "
            "images from it, as with `ffmpeg -i VIDEO -vf fps=1 frame%03d.png`",
            one_line(path),
        )


def frame_rate(path: str) -> float:
    """Frames per second according to the video's header; 30 if that is missing or absurd."""
    with captured_stderr():
        capture = cv2.VideoCapture(path)
        rate = capture.get(cv2.CAP_PROP_FPS)
        capture.release()
    return rate if 0 < rate < _FASTEST else _USUAL


def save_frame(grey: NDArray[np.uint8], path: str) -> None:
    """Write a frame as PNG at once, not with the outputs that a command holds back until its end."""
    Context().run(write_whole, path, encode_png(grey))

"""Undistortion of images: each pixel is interpolated at its source in the distorted image."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Calibrated, Camera, camera_of
from neurocal_cli.camera.geometry import Array, Shape
from neurocal_cli.camera.undistortion import Undistorted, sources, undistorted_view
from neurocal_cli.errors import InputError

Interpolation = Literal["nearest", "linear", "cubic", "lanczos"]
INTERPOLATIONS = {
    "nearest": cv2.INTER_NEAREST,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}

_AT_ONCE = 1 << 20  # pixels whose sources are computed at a time: memory
_KEPT = 1 << 25  # largest image whose sources are kept for the next one, at 8 bytes a pixel
_LONGEST = 32766  # px; OpenCV's remap counts a side in 16 bits
_TYPES = ("uint8", "uint16", "float32", "float64")
_CHANNELS = 4  # most that OpenCV interpolates
_NOWHERE = -1e6  # a source outside every image, which gives black

Sources = tuple[slice, NDArray[np.float32], NDArray[np.float32]]


class Remapping:
    """Undistorts images of one size [px], with one of `INTERPOLATIONS`.

    The new camera has no distortion; without an image size of its own, the result has that of the images. R,
    if given, is from the camera's frame to that of the new one. Raises InputError for a side too long for
    OpenCV.
    """

    def __init__(
        self,
        camera: Camera,
        new: Undistorted,
        size: tuple[int, int],
        interpolation: str = "cubic",
        R: Array | None = None,
    ) -> None:
        new_size = new.image_size or size
        for width, height in (size, new_size):
            if max(width, height) > _LONGEST:
                raise InputError(
                    f"images of {width} x {height} px cannot be undistorted: a side has at most {_LONGEST} "
                    "px; cut them into parts"
                )
        self.camera, self.new, self.size, self.new_size = camera, new, size, new_size
        self.R = R
        self._how = INTERPOLATIONS[interpolation]
        self._kept: list[Sources] = []

    def __call__(
        self, image: NDArray[np.uint8] | NDArray[np.uint16]
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Undistorted image of the same type; black where it has no source.

        The image is a (height, width) or (height, width, channels) array of uint8, uint16, float32 or
        float64, with at most 4 channels. Raises InputError for another size, type or shape.
        """
        size = _size(image)
        if size != self.size:
            raise InputError(
                f"has {size[0]} x {size[1]} px, but the camera is for {self.size[0]} x {self.size[1]} px; "
                "give original images of this camera or, if they were resized, make theirs: neurocal resize "
                f"CAMERA.yaml --to {size[0]} {size[1]} -o RESIZED.yaml"
            )
        whole: NDArray[Any] = np.ascontiguousarray(image)
        undistorted = np.empty((*self.new_size[::-1], *image.shape[2:]), image.dtype)
        for rows, u, v in self._sources():
            part = cv2.remap(whole, u, v, self._how, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
            undistorted[rows] = part.reshape(undistorted[rows].shape)
        return undistorted

    def tables(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Source pixel u and v of each pixel, (height, width), as ``cv2.remap`` takes them."""
        blocks = list(self._sources())
        return np.concatenate([block[1] for block in blocks]), np.concatenate([block[2] for block in blocks])

    def _sources(self) -> Iterator[Sources]:
        """Source pixels in the distorted image, for one block of rows after the other."""
        if self._kept:
            yield from self._kept
            return
        width, height = self.new_size
        rows = max(1, _AT_ONCE // width)
        keep = width * height <= _KEPT
        blocks = []
        for start in range(0, height, rows):
            part = slice(start, min(start + rows, height))
            u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(part.start, part.stop, dtype=float))
            u, v = (
                np.nan_to_num(s, nan=_NOWHERE).clip(_NOWHERE, -_NOWHERE).astype(np.float32)
                for s in sources(self.camera, self.new, u, v, self.R)
            )
            if keep:
                blocks.append((part, u, v))
            yield part, u, v
        self._kept = blocks


def undistort_image(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    camera: Camera | Calibrated,
    alpha: float | None = None,
    interpolation: Interpolation = "cubic",
    to: Shape = "plane",
    fov: float | None = None,
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Undistort an image.

    Parameters
    ----------
    image : (height, width) or (height, width, channels) uint8 or uint16 array
        Also float32 or float64; at most 4 channels.
    camera : Camera or Calibration
    alpha : float, optional
        See `undistortion.new_matrix`; None keeps the camera's own matrix. For a plane without `fov`.
    interpolation : {"nearest", "linear", "cubic", "lanczos"}
    to : {"plane", "cylinder", "equirectangular"}
    fov : float, optional [degrees]
        Field of view from left to right. By default a plane keeps the scale of the middle of the image; the
        others show all that the image does from left to right.

    Returns
    -------
    undistorted : array like the image
        Black where it has no source.

    Raises
    ------
    InputError
        An image of another size than the camera's, or an array of another type or shape.
    """
    camera = camera_of(camera)
    size = camera.image_size or _size(image)
    new = undistorted_view(camera, size, to, fov, alpha=alpha)
    return Remapping(camera, new, size, interpolation)(image)


def _size(image: NDArray[Any]) -> tuple[int, int]:
    """Width and height [px] of an image that OpenCV can interpolate."""
    flat = image.ndim == 2 or (image.ndim == 3 and 1 <= image.shape[2] <= _CHANNELS)
    if not flat or not image.size or image.dtype not in _TYPES:
        raise InputError(
            f"an image must be a (height, width) array of {', '.join(_TYPES)}, with up to {_CHANNELS} "
            f"channels on a third axis, found {image.dtype} of the shape {image.shape}; convert it"
        )
    return image.shape[1], image.shape[0]

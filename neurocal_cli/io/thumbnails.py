"""Thumbnails of photographs, for a page with many of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.io.image_paths import find_images, view_names
from neurocal_cli.io.images import encode_image, read_image, shrink

_WIDEST = 960  # px; the page shows a photograph no wider
_NARROWEST = 120


def photographs_of(views: tuple[str, ...], word: str) -> dict[str, str]:
    """Find the image of each view: the file with its name, without folder and extension.

    `word` is a folder or a pattern, see `find_images`. An InputError says that no view has an image there.
    """
    paths = find_images([word])
    found = dict(zip(view_names(paths), paths, strict=True))
    images = {view: found[view] for view in views if view in found}
    if not images:
        raise InputError(
            f"{word}: no image has the name of a view, such as {views[0] if views else 'none'!s}; give the "
            "folder of the images that were calibrated from"
        )
    return images


def thumbnails(images: Mapping[str, str], size: tuple[int, int] | None, most_bytes: int) -> dict[str, bytes]:
    """Encode images, by name, as small JPEG files with a limit on their total size.

    All must have the `size` [px] if it is known. Only images of the least width may exceed the limit.
    """
    small: dict[str, NDArray[np.uint8]] = {}
    for name, path in images.items():
        image = read_image(path)
        if size is not None and image.size != size:
            raise FormatError(
                f"has {image.size[0]} x {image.size[1]} px, but the camera {size[0]} x {size[1]}; give the "
                "images that were calibrated from",
                image.source,
            )
        small[name] = shrink(image.grey, _WIDEST)
    width = _WIDEST
    while True:
        files = {name: encode_image(shrink(grey, width), ".jpg", 70) for name, grey in small.items()}
        total = sum(map(len, files.values()))
        if total <= most_bytes or width == _NARROWEST:
            return files
        # A thumbnail of half the width takes a little more than a quarter of the bytes.
        width = max(_NARROWEST, int(width * min(0.9, (most_bytes / total) ** 0.6)))

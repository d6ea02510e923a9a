"""Find the image files named by the arguments of a command line."""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.failures import one_line

_ENDINGS = (".png", ".jpg", ".jpeg", ".jpe", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".pnm")


def is_image(path: str) -> bool:
    """Whether a file is an image, judged by its extension."""
    return path.lower().endswith(_ENDINGS)


def find_images(words: Iterable[str]) -> tuple[str, ...]:
    """Find the files given by names, folders and patterns.

    A file (or ``-``) stands for itself, whether it exists or not. A folder stands for the images in it,
    recognised by their extensions. A pattern such as ``left*.png``, which no shell expanded, stands for the
    matching files. Files of folders and patterns are in natural order (1, 2, 10). So are all files if the
    arguments are in alphabetical order.
    """
    paths: list[str] = []
    for word in words:
        if word != "-" and os.path.isdir(word):
            paths += _in_folder(word)
        elif glob.has_magic(word) and not os.path.lexists(word):
            paths += _matching(word)
        else:
            paths.append(word)
    # A shell expands a pattern in alphabetical order, with 10 before 2.
    return tuple(sorted(paths, key=natural_order) if paths == sorted(paths) else paths)


def natural_order(name: str) -> list[tuple[int, str, int]]:
    """Key for sorting names in natural order: left1, left2, left10."""
    parts = re.split(r"([0-9]+)", name)
    return [
        (1, "", int(part)) if part.isdecimal() and part.isascii() else (0, part, 0) for part in parts if part
    ]


def view_names(paths: Iterable[str]) -> tuple[str, ...]:
    """Name a view after each file, without folder and extension; InputError if two have the same name."""
    files = tuple(paths)
    names = tuple("stdin" if path == "-" else Path(path).stem for path in files)
    doubled = next((name for name, count in Counter(names).items() if count > 1), None)
    if doubled is not None:
        first, second, *_ = (
            one_line(path) for path, name in zip(files, names, strict=True) if name == doubled
        )
        if first == second:
            raise InputError(f"{first} is given twice; give each image once")
        raise InputError(f"{first} and {second} would both be the view {doubled!r}; rename one of them")
    return names


def photographs_of(views: tuple[str, ...], word: str) -> dict[str, str]:
    """Find the image of each view in a folder or by a pattern: the file with its name, without extension."""
    paths = find_images([word])
    found = dict(zip(view_names(paths), paths, strict=True))
    images = {view: found[view] for view in views if view in found}
    if not images:
        raise InputError(
            f"{word}: no image has the name of a view, such as {views[0] if views else 'none'!s}; give the "
            "folder of the images that were calibrated from"
        )
    return images


def _in_folder(folder: str) -> list[str]:
    try:
        names = sorted(os.listdir(folder), key=natural_order)
    except OSError as error:
        raise FormatError("may not be read; change its permissions", one_line(folder)) from error
    # Hidden files belong to other programs, such as previews and unfinished copies.
    names = [name for name in names if is_image(name) and not name.startswith(".")]
    paths = [path for path in (os.path.join(folder, name) for name in names) if os.path.isfile(path)]
    if not paths:
        raise FormatError(
            f"holds no images ({', '.join(_ENDINGS)}); give a folder that does", one_line(folder)
        )
    return paths


def _matching(pattern: str) -> list[str]:
    paths = sorted((path for path in glob.glob(pattern) if not os.path.isdir(path)), key=natural_order)
    if not paths:
        raise FormatError("no file matches this pattern; check the path", one_line(pattern))
    return paths

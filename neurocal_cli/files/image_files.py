"""Find the image files that a command line names, and read their size without decoding them.

A file of a kilobyte can state a terabyte of pixels, and decoders treat truncated files differently. Both are
checked here before decoding. No library that neurocal needs anyway does this: OpenCV gives a size only after
decoding (0.4 s for 12 megapixels, where this takes 0.03 s, nearly all of it for checksums), and its versions
from 4.8 to 5.0 fill, cut or refuse truncated files without a reason.
"""

from __future__ import annotations

import glob
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from mmap import ACCESS_READ, mmap
from pathlib import Path

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import FormatError, InputError, one_line

_ENDINGS = (".png", ".jpg", ".jpeg", ".jpe", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".pnm")

_EXIF_MARK = b"Exif\0\0"
_ORIENTATION, _WIDTH, _HEIGHT = 274, 256, 257  # tags of TIFF
_STRIPS = ((273, 279), (324, 325))  # tags of offsets and byte counts of strips, and of tiles
_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_ALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length

# Other kinds of files, by their first bytes.
VIDEO = "video"
_PHONES = ("HEIC", "AVIF")  # kinds that phones save
_OTHERS = (
    (rb".{4}ftyp(heic|heix|hevc|mif1|msf1)", "HEIC"),
    (rb".{4}ftypavi[fs]", "AVIF"),
    (rb".{4}(ftyp|moov|mdat|free|wide)", VIDEO),
    (rb"RIFF.{4}AVI ", VIDEO),
    (rb"RIFF.{4}WEBP", "WebP"),
    (rb"\x1aE\xdf\xa3", VIDEO),  # Matroska, WebM
    (rb"\x00\x00\x01[\xb0-\xbf]", VIDEO),  # MPEG
    (rb"\x30\x26\xb2\x75\x8e\x66\xcf\x11", VIDEO),  # Windows Media
    (rb"GIF8[79]a", "GIF"),
)


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
            found = [path for path in glob.glob(word) if not os.path.isdir(path)]
            if not found:
                raise FormatError("no file matches this pattern; check the path", one_line(word))
            paths += sorted(found, key=natural_order)
        else:
            paths.append(word)
    # A shell expands a pattern in alphabetical order, with 10 before 2.
    return tuple(sorted(paths, key=natural_order) if paths == sorted(paths) else paths)


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


def natural_order(name: str) -> list[tuple[int, str, int]]:
    """Key for sorting names in natural order: left1, left2, left10."""
    parts = re.split(r"([0-9]+)", name)
    return [
        (1, "", int(part)) if part.isdecimal() and part.isascii() else (0, part, 0) for part in parts if part
    ]


def view_names(paths: Iterable[str]) -> tuple[str, ...]:
    """Name a view after each file, without folder and extension.

    Raises InputError if two have the same name, or a name has a line break, which no table can hold.
    """
    files = tuple(paths)
    names = tuple("stdin" if path == "-" else Path(path).stem for path in files)
    broken = next((path for path, name in zip(files, names, strict=True) if re.search(r"[\r\n]", name)), None)
    if broken is not None:
        raise InputError(f"{one_line(broken)} has a line break in its name; rename it")
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
            f"{word}: no image has the name of a view, such as {views[0] if views else 'none'}; give the "
            "folder of the images that were calibrated from"
        )
    return images


@frozen_dataclass
class Header:
    """Size and orientation of a stored image."""

    kind: str  # PNG, JPEG, TIFF, BMP or PNM
    width: int  # px, as is the height; as stored, before the orientation is applied
    height: int
    orientation: int = 1  # of EXIF: 1 upright, 2-8 mirrored or rotated


Data = bytes | mmap


class _TruncatedError(Exception):
    """The file is shorter than its header states."""


def read_header(data: bytes, source: str) -> Header:
    """Read the header of the bytes of a whole image file, and check that the file is complete."""
    if not data:
        raise FormatError("is empty; give an image", source)
    reader = next((read for mark, read in _READERS if re.match(mark, data, re.DOTALL)), None)
    if reader is None:
        other = other_kind(data)
        if other == VIDEO:
            raise FormatError(
                "is a video, but images are wanted; extract some, as with "
                "`ffmpeg -i VIDEO -vf fps=1 frame%03d.png`",
                source,
            )
        if other is None:
            raise FormatError("is not a readable image; give PNG, JPEG, TIFF, BMP, PGM or PPM", source)
        advice = "convert it, as with `heif-convert IN.heic OUT.jpg`, or let the phone save JPEG"
        advice = advice if other in _PHONES else "save it as PNG or JPEG"
        raise FormatError(f"is a {other} file, which is not read; {advice}", source)
    try:
        header = reader(data, True)
    except (_TruncatedError, struct.error, IndexError) as error:
        raise FormatError("is cut off in the middle; copy the image again", source) from error
    except ValueError as error:
        raise FormatError(f"is damaged ({error}); copy the image again", source) from error
    if header.width <= 0 or header.height <= 0:
        raise FormatError(f"has {header.width} x {header.height} px; give an image with pixels", source)
    return header


def other_kind(data: bytes) -> str | None:
    """Kind of a file that is not a supported image; None if unknown."""
    return next((what for mark, what in _OTHERS if re.match(mark, data, re.DOTALL)), None)


def stated_sizes(paths: Iterable[str]) -> Iterator[tuple[int, int] | None]:
    """Larger and smaller side [px] of images, read from their headers.

    The sides are sorted, so the EXIF orientation does not matter. None for stdin, other kinds of files and
    unreadable files: this is only an early check for different cameras, and decoding reports other problems.
    """
    for path in paths:
        try:
            with open(path, "rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
                reader = next((read for mark, read in _READERS if re.match(mark, data, re.DOTALL)), None)
                header = None if reader is None else reader(data, False)
                size = None if header is None else (header.width, header.height)
        except (OSError, ValueError, IndexError, struct.error, _TruncatedError):
            size = None
        yield None if size is None else (max(size), min(size))


def _png(data: Data, whole: bool) -> Header:
    chunks: dict[bytes, bytes] = {}
    bodies = memoryview(data) if isinstance(data, bytes) else data  # not copied
    at, kind = 8, b""
    while kind != b"IEND" and (whole or b"IHDR" not in chunks):
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 8 + length
        if end + 4 > len(data):
            raise _TruncatedError
        if zlib.crc32(bodies[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise ValueError("a checksum is wrong")
        if kind != b"IDAT":
            chunks[kind] = data[at + 8 : end]
        at = end + 4
    width, height = struct.unpack_from(">II", chunks.get(b"IHDR", bytes(8)))
    return Header("PNG", width, height, _exif_orientation(chunks.get(b"eXIf", b"")))


def _jpeg(data: Data, whole: bool) -> Header:
    width = height = 0
    orientation, at = 1, 2
    while whole or not width:
        if data[at] != 0xFF:
            raise ValueError("a marker is missing")
        marker = data[at + 1]
        if marker == 0xFF or marker in _JPEG_ALONE:  # fill bytes, marks
            at += 1 if marker == 0xFF else 2
            continue
        if marker == 0xDA:
            break
        (length,) = struct.unpack_from(">H", data, at + 2)
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
        elif marker == 0xE1 and data[at + 4 : at + 10] == _EXIF_MARK:
            orientation = _exif_orientation(data[at + 10 : at + 2 + length])
        at += 2 + length
    # The end mark is searched after the header: a thumbnail there has one, too.
    if whole and data.rfind(b"\xff\xd9", at) < 0:
        raise _TruncatedError
    return Header("JPEG", width, height, orientation)


def _bmp(data: Data, whole: bool) -> Header:
    (start,) = struct.unpack_from("<I", data, 10)
    width, height, _, depth, packing = struct.unpack_from("<iiHHI", data, 18)
    if packing in (0, 3) and start + (width * depth + 31) // 32 * 4 * abs(height) > len(data):
        raise _TruncatedError
    return Header("BMP", width, abs(height))


def _pnm(data: Data, whole: bool) -> Header:
    numbers = 2 if data[1:2] in b"14" else 3
    gap = rb"(?:\s|#[^\n\r]*[\n\r])+"
    match = re.match(rb"P[1-6]" + (gap + rb"(\d{1,18})") * numbers + rb"\s", data)
    if match is None:
        if len(data) < 15:
            raise _TruncatedError
        raise ValueError("its header is none of PGM or PPM")
    width, height = int(match[1]), int(match[2])
    if data[1:2] in b"56":
        channels = 1 if data[1:2] == b"5" else 3
        if match.end() + width * height * channels * (2 if int(match[3]) > 255 else 1) > len(data):
            raise _TruncatedError
    return Header("PNM", width, height)


def _tiff(data: Data, whole: bool) -> Header:
    fields = _tiff_fields(data)
    for offsets, lengths in _STRIPS:
        ends = [sum(pair) for pair in zip(fields.get(offsets, ()), fields.get(lengths, ()), strict=False)]
        if ends and max(ends) > len(data):
            raise _TruncatedError
    if not (fields.get(_WIDTH) and fields.get(_HEIGHT)):
        raise ValueError("it has no size")
    return Header("TIFF", fields[_WIDTH][0], fields[_HEIGHT][0], _upright(fields.get(_ORIENTATION, (1,))))


def _exif_orientation(block: bytes) -> int:
    """Orientation in an EXIF block, which is a TIFF without an image; 1 if it cannot be read."""
    try:
        return _upright(_tiff_fields(block).get(_ORIENTATION, (1,)))
    except (struct.error, ValueError, IndexError, _TruncatedError):
        return 1


def _upright(values: tuple[int, ...]) -> int:
    return values[0] if values and 1 <= values[0] <= 8 else 1


def _tiff_fields(data: Data) -> dict[int, tuple[int, ...]]:
    """Integer fields of the first directory of a TIFF or BigTIFF, by their tags."""
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    number, count, step = ("Q", "Q", 20) if big else ("I", "H", 12)
    (at,) = struct.unpack_from(order + number, data, 8 if big else 4)
    (entries,) = struct.unpack_from(order + count, data, at)
    at += struct.calcsize(count)
    room = struct.calcsize(number)
    fields = {}
    for entry in range(at, at + step * min(entries, 4096), step):
        tag, kind, n = struct.unpack_from(f"{order}HH{number}", data, entry)
        if kind not in _TIFF_TYPES:
            continue
        form = f"{order}{min(n, len(data))}{_TIFF_TYPES[kind]}"  # a file cannot have more values than bytes
        place = entry + 4 + room
        if struct.calcsize(form) > room:
            (place,) = struct.unpack_from(order + number, data, place)
        fields[tag] = struct.unpack_from(form, data, place)
    return fields


# From the bytes of a file, and whether all of it is checked.
_READERS: tuple[tuple[bytes, Callable[[Data, bool], Header]], ...] = (
    (rb"\x89PNG\r\n\x1a\n", _png),
    (rb"\xff\xd8\xff", _jpeg),
    (rb"(?:II|MM).?[*+]", _tiff),
    (rb"BM.{8}", _bmp),
    (rb"P[1-6][\s#]", _pnm),
)

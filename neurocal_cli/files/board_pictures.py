"""Write a sheet with a board as SVG, PDF or PNG, at its exact size.

SVG and PDF contain the squares as polygons, in millimetres and points. All are one path: where the black
cells of a marker are drawn one by one, many printers and viewers leave a grey seam between them. PNG contains
their exact coverage of each pixel, and the resolution.
"""

from __future__ import annotations

import struct
import zlib
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.observations.printed_sheet import Line, Sheet, Text

_POINT = 72 / 25.4  # points per millimetre
_DASH = 1.0  # mm
_MOST_PIXELS = 200_000_000
# Points of a circle of radius 1 by four Bezier curves: the start, then two controls and the end of each. The
# error is 0.0003 of the radius.
_BEND = 0.5519150244935106
_QUARTER = np.array([[1, _BEND], [_BEND, 1], [0, 1]])
_CIRCLE = np.concatenate(
    [[[1.0, 0.0]], *(_QUARTER @ np.linalg.matrix_power([[0, 1], [-1, 0]], k) for k in range(4))]
)


def board_svg(sheet: Sheet) -> str:
    """Write the sheet as SVG in millimetres."""
    path = "\n".join(f"M{' L'.join(f'{x:.6f} {y:.6f}' for x, y in square)} Z" for square in sheet.squares)
    squares = f'<path d="{path}"/>' if path else ""
    squares += "".join(f'\n<circle cx="{x:.6f}" cy="{y:.6f}" r="{r:.6f}"/>' for x, y, r in sheet.discs)
    lines = "\n".join(
        f'<line x1="{line.start[0]:.6f}" y1="{line.start[1]:.6f}" x2="{line.end[0]:.6f}" '
        f'y2="{line.end[1]:.6f}" stroke-width="{line.width}"'
        + (f' stroke-dasharray="{_DASH}"' if line.dashed else "")
        + "/>"
        for line in sheet.lines
    )
    texts = "\n".join(
        f'<text x="{text.place[0]:.4f}" y="{text.place[1]:.4f}" font-size="{text.size}"'
        + (' text-anchor="middle"' if text.middle else "")
        + f">{escape(text.content)}</text>"
        for text in sheet.texts
    )
    w, h = f"{sheet.width:g}", f"{sheet.height:g}"
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w}mm" height="{h}mm" viewBox="0 0 {w} {h}">\n'
        f'<rect width="{w}" height="{h}" fill="white"/>\n'
        f'<g id="squares" fill="black">\n{squares}\n</g>\n'
        f'<g id="lines" stroke="black">\n{lines}\n</g>\n'
        f'<g font-family="Helvetica, Arial, sans-serif" fill="black">\n{texts}\n</g>\n</svg>\n'
    )


def board_pdf(sheet: Sheet) -> bytes:
    """Write the sheet as a PDF of one page of its size."""

    def place(point: Array) -> str:
        return f"{point[0] * _POINT:.5f} {(sheet.height - point[1]) * _POINT:.5f}"

    content = ["0 g 0 G"]
    for square in sheet.squares:
        content.append(f"{place(square[0])} m {' '.join(f'{place(p)} l' for p in square[1:])} h")
    content += ["f"] if len(sheet.squares) else []
    for x, y, radius in sheet.discs:
        first, *others = [place(p) for p in np.array([x, y]) + radius * _CIRCLE]
        curves = [" ".join(others[k : k + 3]) + " c" for k in range(0, len(others), 3)]
        content.append(" ".join([f"{first} m", *curves, "h f"]))
    for line in sheet.lines:
        dash = f"[{_DASH * _POINT:.4f}] 0 d" if line.dashed else "[] 0 d"
        content.append(f"{dash} {line.width * _POINT:.4f} w {place(line.start)} m {place(line.end)} l S")
    for text in sheet.texts:
        shown = text.content.encode("ascii", "replace").decode("ascii")
        shown = shown.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        # Centred texts are numbers, and the width of Helvetica's digits is 0.556 of the font size.
        left = text.place[0] - (0.5 * 0.556 * text.size * len(text.content) if text.middle else 0.0)
        x, y = left * _POINT, (sheet.height - text.place[1]) * _POINT
        content.append(f"BT /F {text.size * _POINT:.4f} Tf {x:.4f} {y:.4f} Td ({shown}) Tj ET")
    stream = "\n".join(content).encode("ascii")
    box = f"[0 0 {sheet.width * _POINT:.5f} {sheet.height * _POINT:.5f}]"
    # Ask viewers not to scale the page to the paper when they print it.
    return _pdf(
        [
            b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R "
            "/Resources << /Font << /F 5 0 R >> >> >>".encode("ascii"),
            f"<< /Length {len(stream)} >>\nstream\n".encode("ascii") + stream + b"\nendstream",
            b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        ]
    )


def _pdf(objects: list[bytes]) -> bytes:
    """Number the objects, the catalogue first, and add the table of the bytes at which they begin."""
    data, places = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, start=1):
        places.append(len(data))
        data += f"{number} 0 obj\n".encode("ascii") + body + b"\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    end = f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(data)}\n%%EOF\n"
    return data + f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}{end}".encode("ascii")


def board_png(sheet: Sheet, dpi: float) -> bytes:
    """Write the sheet as a grey PNG with its resolution; raise an InputError beyond 200 million pixels."""
    pixels = dpi / 25.4  # per millimetre
    width, height = round(sheet.width * pixels), round(sheet.height * pixels)
    if width * height > _MOST_PIXELS:
        raise InputError(f"the picture would have {width} x {height} pixels; give a smaller --dpi")
    ink = np.zeros((height, width), dtype=np.float32)
    for square in sheet.squares:
        _cover(ink, pixels * square.min(axis=0), pixels * square.max(axis=0))
    for x, y, radius in pixels * sheet.discs:
        _cover_disc(ink, np.array([x, y]), radius)
    for line in sheet.lines:
        for start, end in _dashes(line):
            ends = np.array([start, end])
            half = 0.5 * line.width
            low, high = ends.min(axis=0), ends.max(axis=0)
            across = 0 if high[0] - low[0] < high[1] - low[1] else 1
            low[across], high[across] = low[across] - half, high[across] + half
            _cover(ink, pixels * low, pixels * high)
    _write_texts(ink, sheet.texts, pixels)
    grey = np.round(255 * (1 - np.clip(ink, 0, 1))).astype(np.uint8)
    return _png(grey, dpi)


def _dashes(line: Line) -> list[tuple[Array, Array]]:
    """Ends of the dashes of a line, or of the whole line."""
    if not line.dashed:
        return [(line.start, line.end)]
    length = float(np.linalg.norm(line.end - line.start))
    along = (line.end - line.start) / length
    marks = np.arange(0.0, length, 2 * _DASH)
    return [(line.start + a * along, line.start + min(a + _DASH, length) * along) for a in marks]


def _cover(ink: NDArray[np.float32], low: Array, high: Array) -> None:
    """Add an axis-aligned rectangle with corners `low` and `high` [px], by the covered part of each pixel."""
    parts = []
    for axis, count in ((1, ink.shape[0]), (0, ink.shape[1])):
        first, last = max(int(low[axis]), 0), min(int(np.ceil(high[axis])), count)
        edges = np.arange(first, last + 1)
        covered = np.clip(np.minimum(edges[1:], high[axis]) - np.maximum(edges[:-1], low[axis]), 0, 1)
        parts.append((slice(first, last), covered))
    (rows, down), (cols, right) = parts
    ink[rows, cols] += np.outer(down, right)


def _cover_disc(ink: NDArray[np.float32], centre: Array, radius: float) -> None:
    """Add a disc [px], by the part of each pixel on the inner side of its edge."""
    low = np.maximum(np.floor(centre - radius).astype(int), 0)
    high = np.minimum(np.ceil(centre + radius).astype(int) + 1, ink.shape[::-1])
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]]
    distance = np.hypot(u + 0.5 - centre[0], v + 0.5 - centre[1])
    ink[low[1] : high[1], low[0] : high[0]] += np.clip(radius + 0.5 - distance, 0, 1).astype(np.float32)


def _write_texts(ink: NDArray[np.float32], texts: tuple[Text, ...], pixels: float) -> None:
    import cv2

    picture = np.zeros(ink.shape, dtype=np.uint8)
    for text in texts:
        scale = 0.7 * text.size * pixels / 21.0  # capitals of this font are 21 px high
        thick = max(1, round(0.1 * text.size * pixels))
        (width, _), _ = cv2.getTextSize(text.content, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
        x, y = text.place[0] * pixels - (0.5 * width if text.middle else 0), text.place[1] * pixels
        place = round(x), round(y)
        cv2.putText(picture, text.content, place, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, thick, cv2.LINE_AA)
    ink += picture / np.float32(255)


def _png(grey: NDArray[np.uint8], dpi: float) -> bytes:
    """Encode a PNG with the resolution in its chunk pHYs, in whole pixels per metre."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)

    height, width = grey.shape
    metre = round(dpi / 0.0254)
    rows = np.zeros((height, width + 1), dtype=np.uint8)  # the first byte of a row is its filter, 0 for none
    rows[:, 1:] = grey
    return b"".join(
        [
            b"\x89PNG\r\n\x1a\n",
            chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)),
            chunk(b"pHYs", struct.pack(">IIB", metre, metre, 1)),
            chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)),
            chunk(b"IEND", b""),
        ]
    )

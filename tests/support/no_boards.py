"""Pictures of things in rows that are no board: dice, keys, windows, codes, text, seen askew."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Canvas = NDArray[np.uint8]

_FINE = 4  # pixels of a drawing for one of the picture, at least
_SIZE = (640, 480)
_PIPS = {
    1: [(0, 0)],
    2: [(-1, -1), (1, 1)],
    3: [(-1, -1), (0, 0), (1, 1)],
    4: [(-1, -1), (1, -1), (-1, 1), (1, 1)],
    5: [(-1, -1), (1, -1), (0, 0), (-1, 1), (1, 1)],
    6: [(-1, -1), (-1, 0), (-1, 1), (1, -1), (1, 0), (1, 1)],
}
_TEXTS = ("o", "0", "8", "O", "oo", "e", "B", "@", ".", ":", "%", "88", "a", "D", "Q", "6")


def picture(kind: str, seed: int) -> Canvas:
    """A picture of 640 x 480 px of a kind of things, from ``KINDS``."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    drawing = _DRAW[kind](rng)
    height, width = drawing.shape
    # Its corners in the picture, somewhat in perspective; mostly all of it is seen.
    scale = rng.uniform(0.55, 1.0) * min(_SIZE[0] / width, _SIZE[1] / height)
    turn, squeeze = rng.uniform(-0.3, 0.3) + (np.pi / 2) * rng.integers(4), rng.uniform(0.6, 1.0)
    c, s = np.cos(turn), np.sin(turn)
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)
    flat = (corners - corners.mean(axis=0)) * [1, squeeze] * scale
    flat /= 1 + (flat @ rng.uniform(-0.25, 0.25, 2) / _SIZE[0])[:, None]
    seen = flat @ [[c, s], [-s, c]]
    room = 0.5 * np.array(_SIZE)
    seen = (
        seen * min(1.0, float((1.05 * room / np.abs(seen).max(axis=0)).min()))
        + room
        + rng.uniform(-15, 15, 2)
    )
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), (2 * seen).astype(np.float32))
    around = int(drawing[0, 0]) if rng.random() < 0.6 else int(rng.integers(20, 235))
    large = cv2.warpPerspective(
        cv2.GaussianBlur(drawing, (0, 0), 0.8),
        H,
        (2 * _SIZE[0], 2 * _SIZE[1]),
        flags=cv2.INTER_AREA,
        borderValue=around,
    )
    light = cv2.resize(large, _SIZE, interpolation=cv2.INTER_AREA).astype(float)
    light = cv2.GaussianBlur(light, (0, 0), rng.choice([0.4, 0.7, 1.0, 1.5]))
    u, v = np.meshgrid(np.linspace(-1, 1, _SIZE[0]), np.linspace(-1, 1, _SIZE[1]))
    light *= 1 + 0.25 * (rng.uniform(-1, 1) * u + rng.uniform(-1, 1) * v)
    light += rng.normal(0, rng.choice([0.5, 2.0, 5.0]), light.shape)
    return np.clip(np.rint(light), 0, 255).astype(np.uint8)


def _levels(rng: np.random.Generator) -> tuple[int, int]:
    """A level of the ground and one of what is on it."""
    dark, light = int(rng.integers(10, 80)), int(rng.integers(150, 250))
    return (light, dark) if rng.random() < 0.6 else (dark, light)


def _rows(
    rng: np.random.Generator,
    pitch: tuple[float, float],
    draw: Callable[[Canvas, int, int], None],
    ground: int,
) -> Canvas:
    """A drawing of things at a pitch, a margin around them."""
    cols, rows = int(rng.integers(3, 13)), int(rng.integers(3, 10))
    dx, dy = (round(p) for p in pitch)
    canvas = np.full((rows * dy + 2 * dy, cols * dx + 2 * dx), ground, dtype=np.uint8)
    shifted = dx // 2 if rng.random() < 0.2 else 0
    for j in range(rows):
        for i in range(cols):
            draw(canvas, round((i + 1.5) * dx) + shifted * (j % 2), round((j + 1.5) * dy))
    return canvas


def _box(canvas: Canvas, x: float, y: float, w: float, h: float, level: int, corner: float = 0.0) -> None:
    """Draw a filled rectangle around a middle, with rounded corners."""
    r = round(min(corner, 0.45 * min(w, h)))
    left, top, right, bottom = (round(one) for one in (x - w / 2, y - h / 2, x + w / 2, y + h / 2))
    cv2.rectangle(canvas, (left + r, top), (right - r, bottom), (level,), -1)
    if r:
        cv2.rectangle(canvas, (left, top + r), (right, bottom - r), (level,), -1)
        for u in (left + r, right - r):
            for v in (top + r, bottom - r):
                cv2.circle(canvas, (u, v), r, (level,), -1, cv2.LINE_AA)


def _text(
    canvas: Canvas, x: float, y: float, height: float, text: str, level: int, weight: float = 0.16
) -> None:
    scale = height / 22
    thick = max(1, round(weight * height))
    (w, h), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    place = (round(x - w / 2), round(y + h / 2))
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (level,), thick, cv2.LINE_AA)


def _dice(rng: np.random.Generator) -> Canvas:
    """Dice of one number or of several, with gaps or without."""
    side = int(rng.integers(30, 90)) * _FINE // 2
    ground, die = int(rng.integers(20, 150)), int(rng.integers(170, 250))
    pip = int(rng.integers(5, 70))
    equal, number = rng.random() < 0.7, int(rng.integers(1, 7))
    gap, radius, apart = rng.choice([0.02, 0.1, 0.3]), rng.uniform(0.07, 0.14), rng.uniform(0.22, 0.3)

    def one(canvas: Canvas, x: int, y: int) -> None:
        _box(canvas, x, y, side, side, die, rng.choice([0.05, 0.2]) * side)
        turned = rng.random() < 0.2
        for a, b in _PIPS[number if equal else int(rng.integers(1, 7))]:
            a, b = (b, -a) if turned else (a, b)
            at = (round(x + apart * side * a), round(y + apart * side * b))
            cv2.circle(canvas, at, round(radius * side), (pip,), -1, cv2.LINE_AA)

    return _rows(rng, ((1 + gap) * side, (1 + gap) * side), one, ground)


def _dominoes(rng: np.random.Generator) -> Canvas:
    side = int(rng.integers(24, 60)) * _FINE // 2
    ground, pip = int(rng.integers(20, 150)), int(rng.integers(5, 70))
    numbers, equal = rng.integers(1, 7, 2), rng.random() < 0.5

    def one(canvas: Canvas, x: int, y: int) -> None:
        _box(canvas, x, y, side, 2 * side, 235, 0.1 * side)
        cv2.line(canvas, (x - side // 3, y), (x + side // 3, y), (pip,), max(1, side // 20))
        for half, number in zip((-0.5, 0.5), numbers if equal else rng.integers(1, 7, 2), strict=True):
            for a, b in _PIPS[int(number)]:
                at = (round(x + 0.27 * side * a), round(y + side * (half + 0.27 * b)))
                cv2.circle(canvas, at, round(0.09 * side), (pip,), -1, cv2.LINE_AA)

    return _rows(rng, (1.2 * side, 2.2 * side), one, ground)


def _rectangles(rng: np.random.Generator) -> Canvas:
    """Small rectangles, of 8 to 16 px in the picture where this is not smaller."""
    w = int(rng.integers(7, 17)) * _FINE
    h = round(w * rng.uniform(0.6, 1.5))
    ground, level = _levels(rng)
    corner = rng.choice([0.0, 0.1, 0.25]) * w
    pitch = (w * rng.uniform(1.4, 3.0), h * rng.uniform(1.4, 3.0))
    return _rows(rng, pitch, lambda canvas, x, y: _box(canvas, x, y, w, h, level, corner), ground)


def _keys(rng: np.random.Generator) -> Canvas:
    """Keys of a keyboard or a key pad, with signs on most of them."""
    side = int(rng.integers(24, 60)) * _FINE // 2
    ground, level = _levels(rng)
    sign = 230 if level < 100 else 20
    corner, signs = rng.choice([0.1, 0.25, 0.45]), rng.random() < 0.85
    gap = rng.choice([0.1, 0.3, 0.8])

    def one(canvas: Canvas, x: int, y: int) -> None:
        _box(canvas, x, y, side, side, level, corner * side)
        if signs:
            text = "1234567890QWERTZUIOP*#"[int(rng.integers(22))]
            _text(canvas, x, y, 0.45 * side, text, sign, 0.12)

    return _rows(rng, ((1 + gap) * side, (1 + gap) * side), one, ground)


def _lamps(rng: np.random.Generator) -> Canvas:
    """A panel of lamps, of which only those of a pattern are lit."""
    side = int(rng.integers(10, 24)) * _FINE // 2
    lit, share = int(rng.integers(160, 255)), rng.uniform(0.3, 0.8)

    def one(canvas: Canvas, x: int, y: int) -> None:
        level = lit if rng.random() < share else 45
        cv2.circle(canvas, (x, y), side // 2, (level,), -1, cv2.LINE_AA)

    return _rows(rng, (1.5 * side, 1.5 * side), one, 20)


def _table(rng: np.random.Generator) -> Canvas:
    """A table or a calendar with lines around its cells."""
    w, h = (int(rng.integers(24, 70)) * _FINE // 2 for _ in range(2))
    ruled, number = rng.random() < 0.7, rng.random() < 0.5
    text = _TEXTS[int(rng.integers(len(_TEXTS)))]

    def one(canvas: Canvas, x: int, y: int) -> None:
        if ruled:
            cv2.rectangle(canvas, (x - w // 2, y - h // 2), (x + w // 2, y + h // 2), (40,), max(1, w // 40))
        _text(canvas, x, y, 0.4 * min(w, h), str(rng.integers(1, 32)) if number else text, 30)

    return _rows(rng, (w, h), one, int(rng.integers(190, 250)))


def _letters(rng: np.random.Generator) -> Canvas:
    """Rows of one letter, some of which are nearly round."""
    height = int(rng.integers(10, 40)) * _FINE // 2
    ground, level = _levels(rng)
    text, weight = _TEXTS[int(rng.integers(len(_TEXTS)))], rng.uniform(0.1, 0.3)
    pitch = (height * rng.uniform(1.2, 2.5) * len(text), height * rng.uniform(1.4, 2.5))
    return _rows(rng, pitch, lambda canvas, x, y: _text(canvas, x, y, height, text, level, weight), ground)


def _code(rng: np.random.Generator) -> Canvas:
    """A code of squares like QR."""
    n = int(rng.integers(12, 40))
    cells = (rng.random((n, n)) < 0.5).astype(np.uint8)
    for at in (np.s_[:7, :7], np.s_[:7, -7:], np.s_[-7:, :7]):
        ring = np.zeros((7, 7), np.uint8)
        ring[1:6, 1:6] = 1
        ring[2:5, 2:5] = 0
        cells[at] = ring
    fine = cv2.resize(
        np.pad(cells, 4, constant_values=1), None, fx=32, fy=32, interpolation=cv2.INTER_NEAREST
    )
    return np.asarray(30 + 200 * fine, dtype=np.uint8)


def _windows(rng: np.random.Generator) -> Canvas:
    """Windows with frames and bars."""
    w = int(rng.integers(16, 50)) * _FINE // 2
    h = round(w * rng.uniform(0.8, 1.8))
    ground, level = _levels(rng)
    frame, bars = rng.uniform(0, 0.12), int(rng.integers(0, 3))

    def one(canvas: Canvas, x: int, y: int) -> None:
        _box(canvas, x, y, (1 + 2 * frame) * w, h + 2 * frame * w, (level + ground) // 2)
        _box(canvas, x, y, w, h, level)
        if bars > 0:
            cv2.line(canvas, (x, y - h // 2), (x, y + h // 2), (ground,), max(1, w // 12))
        if bars > 1:
            cv2.line(canvas, (x - w // 2, y), (x + w // 2, y), (ground,), max(1, w // 12))

    return _rows(rng, (w * rng.uniform(1.4, 2.5), h * rng.uniform(1.3, 2.2)), one, ground)


def _bricks(rng: np.random.Generator) -> Canvas:
    h = int(rng.integers(14, 40)) * _FINE // 2
    w = round(h * rng.uniform(1.0, 2.6))
    ground, level = _levels(rng)
    gap = rng.uniform(0.08, 0.3) * h
    return _rows(rng, (w + gap, h + gap), lambda canvas, x, y: _box(canvas, x, y, w, h, level), ground)


def _bottles(rng: np.random.Generator) -> Canvas:
    """A crate of bottles or tins seen from above: round things, each in a compartment of its own."""
    side = int(rng.integers(24, 70)) * _FINE // 2
    wall, floor, lid = (int(one) for one in rng.permutation([40, 120, 220]))
    share, rim = rng.uniform(0.5, 0.85), rng.random() < 0.5

    def one(canvas: Canvas, x: int, y: int) -> None:
        _box(canvas, x, y, 0.92 * side, 0.92 * side, floor)
        cv2.circle(canvas, (x, y), round(0.46 * share * side), (lid,), -1, cv2.LINE_AA)
        if rim:
            cv2.circle(canvas, (x, y), round(0.3 * share * side), (wall,), max(1, side // 30), cv2.LINE_AA)

    return _rows(rng, (side, side), one, wall)


def _pieces(rng: np.random.Generator) -> Canvas:
    """A game of round pieces of several colours."""
    side = int(rng.integers(20, 60)) * _FINE // 2
    colours = rng.integers(10, 250, 3)

    def one(canvas: Canvas, x: int, y: int) -> None:
        cv2.circle(canvas, (x, y), round(0.38 * side), (int(rng.choice(colours)),), -1, cv2.LINE_AA)

    return _rows(rng, (side, side), one, int(rng.integers(60, 200)))


def _crossword(rng: np.random.Generator) -> Canvas:
    side, share = int(rng.integers(16, 40)) * _FINE // 2, rng.uniform(0.1, 0.5)

    def one(canvas: Canvas, x: int, y: int) -> None:
        half = side // 2
        dark = rng.random() < share
        cv2.rectangle(
            canvas, (x - half, y - half), (x + half, y + half), (30,), -1 if dark else max(1, side // 20)
        )

    return _rows(rng, (side, side), one, 235)


def _polygons(rng: np.random.Generator) -> Canvas:
    """Nuts, studs or stars: regular polygons of few corners."""
    radius = int(rng.integers(7, 24)) * _FINE // 2
    n, star = int(rng.choice([3, 4, 5, 6])), rng.random() < 0.3
    ground, level = _levels(rng)
    turn = rng.uniform(0, 2 * np.pi)
    angle = turn + np.pi * np.arange(2 * n) / n
    reach = radius * np.where(np.arange(2 * n) % 2 == 0, 1.0, 0.5 if star else np.cos(np.pi / n))
    shape = np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=-1)
    pitch = radius * rng.uniform(2.6, 4.5)

    def one(canvas: Canvas, x: int, y: int) -> None:
        cv2.fillPoly(canvas, [np.rint(shape + np.array([x, y])).astype(np.int32)], (level,), cv2.LINE_AA)

    return _rows(rng, (pitch, pitch), one, ground)


def _targets(rng: np.random.Generator) -> Canvas:
    """Targets of several rings, one in the other."""
    side = int(rng.integers(30, 90)) * _FINE // 2
    ground, level = _levels(rng)
    bands = 2 * int(rng.integers(2, 5)) - 1

    def one(canvas: Canvas, x: int, y: int) -> None:
        for k in range(bands):
            radius = round(0.42 * side * (1 - k / bands))
            cv2.circle(canvas, (x, y), radius, (ground if k % 2 else level,), -1, cv2.LINE_AA)

    return _rows(rng, (side, side), one, ground)


def _discs(rng: np.random.Generator) -> Canvas:
    """Discs of one colour and of any size."""
    side = int(rng.integers(24, 60)) * _FINE // 2
    ground, level = _levels(rng)

    def one(canvas: Canvas, x: int, y: int) -> None:
        radius = round(rng.uniform(0.2, 0.42) * side)
        cv2.circle(canvas, (x, y), radius, (level,), -1, cv2.LINE_AA)

    return _rows(rng, (side, side), one, ground)


_DRAW: dict[str, Callable[[np.random.Generator], Canvas]] = {
    "dice": _dice,
    "dominoes": _dominoes,
    "rectangles": _rectangles,
    "keys": _keys,
    "lamps": _lamps,
    "tables": _table,
    "letters": _letters,
    "codes": _code,
    "windows": _windows,
    "bricks": _bricks,
    "bottles": _bottles,
    "pieces": _pieces,
    "crosswords": _crossword,
    "polygons": _polygons,
    "targets": _targets,
    "discs": _discs,
}
KINDS = tuple(_DRAW)

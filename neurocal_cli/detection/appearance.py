"""What a board looks like: marks of one shape and one ink, with blank paper between them.

The light around all marks is compared in the coordinates of the board, in which circles are circles and
squares are squares whatever the tilt, and averaged. So noise and things before the board matter little.

Pips of dice, keys, lamps, pieces of a game and bottles in a crate stand in rows, too. But a die has an
outline and a compartment a wall, so the light changes between the marks; signs are in keys; lamps may be off;
other marks are long or have corners. Ink reflects the same share of the paper's light at all places; all
circles of a board have one radius; and from its middle outwards, the light of a disc or a ring has the steps
of one blurred edge or two, where that of a ball, of a coin or of a target has others.

The squares of a chessboard meet at their corners, unless light or ink have moved all edges alike. Then the
light at the middles of the edges tells the light at the corners, whatever the blur. With s(t) the share of
its own colour at a distance t within a side, it is on the diagonal, as near to both sides,

    s(t)^2 + s(-t)^2 - max(s(t) + s(-t) - 1, 0)^2

The second term is the next square of that colour, and the last is what both share if they overlap. Round
marks and squares with rounded corners have less there. Ink spreads alike along both axes, and light by a
share of the blur along each, while windows or bricks in shifted rows have gaps along one axis, or different
ones. Squares that are not of one level have markers in them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.saddles import Image, interpolate
from neurocal_cli.detection.fitting.edge_profile import erf_and_density
from neurocal_cli.detection.grid import squares_of, weights_within
from neurocal_cli.detection.markers.lattice import flattening_of, predicted

_RAYS = 16
_FIRST, _STEP = 0.05, 0.05  # of the radius, from where on the light is looked at on rings
_LEVEL_FROM = 5  # the ring of 0.3; smaller ones have few pixels, so that their light is noisy
_INSIDE, _AROUND = 7, 1.5  # the ring of 0.4, within all marks, and the radius up to which a mark ends
_NEXT = 0.54  # of the distance to the next mark, of the last ring
_BLUR = 2.2  # standard deviations of the blur from the edge to where the paper is blank
_BLURS = 0.7, 0.85, 1.0, 1.2  # of that by the steepest place, which samples on rings do not meet
_NEAR = 4.0  # standard deviations of the blur, within which a sharpened edge overshoots
_HOLE = 0.5  # least step of the light at the edge of a hole, over that at the other edge
_SURE = 4.0  # standard deviations of the noise
_STAGGERED = 1.2  # distance of the next marks in steps; 1.4 where each second row is shifted

_LABELLED = 1 / 8  # of the marks, beside which there may be ink, or which are partly hidden

# What grids of circles hardly depart by, in px of their outlines and in contrasts of the light.
_OFF = 0.1  # px, from where those around a mark predict it
_SIZES = 0.05  # px rms, of the radius from a smooth change
_LONG = 0.06  # px, of two periods of most outlines by the angle, beyond noise
# px, of three to seven periods of the mean outline, beyond twice what the marks differ by; pixels have four.
_CORNERED = np.array([0.004, 0.012, 0.004, 0.004, 0.004])
_CORNERED_DRAWN = 0.05  # px, the same for described boards, which may be drawn in whole pixels
_HEXAGON = 6  # periods
_INKS = 0.013  # rms, of the share of the paper's light from a smooth change
_MIXED = 0.007  # rms, of the light by the distance from that of a disc or a ring
_SIGNED = 0.06  # spread of the light within most marks beyond that around them
_RULED = 0.015  # change of the light in the paper between the marks


@frozen_dataclass(eq=False)
class _Rings:
    """The light around N marks, on rings of the board."""

    off: float  # px, from where those around a mark predict it
    radius: float  # of marks, in the coordinates of the board
    scale: float  # px, the same
    apart: float  # distance of marks
    shares: Array  # (rings,) of the radius
    shift: Array  # (rings, rays, 2) from the centre, in the coordinates of the board
    levels: Array  # (N, rings, rays)


def _rings(light: Image, places: Array, centre: Array, area: Array) -> _Rings:
    flattening = flattening_of(places, centre, (light.shape[1], light.shape[0]))
    start, steps = predicted(places, places, centre, flattening, itself=False)
    side = np.sqrt(np.maximum(np.abs(np.linalg.det(steps)), 1e-9))
    away = np.hypot(*(places[:, None] - places).transpose(2, 0, 1))
    apart = float(away[away > 0].min())
    radius = min(float(np.median(np.sqrt(area / np.pi) / side)), 0.5 * apart)
    # The first angle of each quarter is farthest from the next marks.
    angle = 2 * np.pi * np.arange(_RAYS) / _RAYS + (0.25 * np.pi if apart < _STAGGERED else 0.0)
    shares = np.arange(_FIRST, _NEXT * apart / radius, _STEP)
    shift = radius * shares[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    levels = interpolate(light, centre[:, None, None] + shift @ steps[:, None])
    off = float(np.median(np.hypot(*(centre - start).T)))
    return _Rings(off, radius, radius * float(np.median(side)), apart, shares, shift, levels)


def departure_from_circles(
    light: Image, places: Array, centre: Array, area: Array, described: bool
) -> tuple[float, float]:
    """How far marks (N,) of an area [px^2] at places (N, 2) of a board are from circles on blank paper.

    What they depart by is added up in squares, over what grids of circles hardly depart by; the second figure
    is that of hexagons, of their size and blur, in their place. Some marks of a `described` board may be
    hidden, and its outlines be drawn in whole pixels.
    """
    rings = _rings(light, places, centre, area)
    radius, scale, shares, levels = rings.radius, rings.scale, rings.shares, rings.levels
    middle, edge = np.count_nonzero(shares < 1), np.count_nonzero(shares < _AROUND) - 1
    # A ring may be light in its middle.
    profile = np.median(levels[..., :: _RAYS // 4].mean(axis=2), axis=0)
    inner = _LEVEL_FROM + int(np.abs(profile[_LEVEL_FROM:middle] - profile[edge]).argmax())
    outer = middle + int(np.abs(profile[middle : edge + 1] - profile[inner]).argmax())
    ring = np.median(levels, axis=2)
    contrast = ring[:, outer] - ring[:, inner]
    x, y = (places - places.mean(axis=0)).T / max(float(np.ptp(places)), 1.0)
    smooth = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)

    def odd(values: Array) -> float:
        """What marks differ by (rms) from a smooth change; some of a described board may be hidden."""
        change = smooth @ np.linalg.lstsq(smooth, values, rcond=None)[0]
        seen = round((1 - described * _LABELLED) * len(values))
        return float(np.sqrt(np.sort((values - change) ** 2)[:seen].mean()))

    # Ink reflects the same share of the paper's light everywhere, in the shade as well.
    mark, paper = np.maximum(ring[:, inner], 0.0), np.maximum(ring[:, outer], 0.0)
    if profile[inner] > profile[outer]:
        mark, paper = paper, mark
    ink = mark / np.maximum(paper, 1.0)
    inks = odd(ink) / max(1 - float(np.median(ink)), 0.1)
    levels -= ring[:, inner, None, None]
    levels /= np.where(np.abs(contrast) < 1, 1.0, contrast)[:, None, None]
    mean = levels.mean(axis=(0, 2))
    darker = np.flatnonzero(mean[: outer + 1] < 0.5)
    if not len(darker):
        return np.inf, np.inf
    half = int(darker[-1])
    across = levels[:, inner : outer + 1].mean(axis=2)
    beyond = np.maximum((across > 0.5).argmax(axis=1), 1)
    before, after = (across[np.arange(len(across)), k] for k in (beyond - 1, beyond))
    back = np.clip((after - 0.5) / np.maximum(after - before, 0.1), 0, 1)
    sizes = scale * odd(np.log(shares[inner + beyond] - _STEP * back))
    within, around = (float(np.median(levels[:, k].std(axis=1))) for k in (_INSIDE, edge))
    signed = np.sqrt(max(within**2 - around**2, 0.0))
    step = abs(profile[outer] - profile[inner])
    blur = _STEP * step / max(np.sqrt(2 * np.pi) * np.abs(np.diff(profile)).max(), 1e-9)  # of the radius
    # The light is half-way between this ring and the next one.
    further = min(half + 1, len(mean) - 1)
    between = (0.5 - mean[half]) / max(mean[further] - mean[half], 0.5 - mean[half], 1e-9)
    outline = levels[:, half] + between * (levels[:, further] - levels[:, half])
    long, cornered, hexagons = _outline(np.sqrt(2 * np.pi) * blur * scale * outline, described)
    reach = shares[half] + between * _STEP  # of the outline; blurred marks seem larger
    hexagons *= scale * reach * np.exp(-0.5 * (_HEXAGON * blur / reach) ** 2)
    near = radius * shares < 0.5 * rings.apart
    mixed = _misfit(mean[near], shares[near])
    blank = reach + _BLUR * blur
    ruled = _ruled(rings, (shares > blank) & (shares < rings.apart / radius - blank), places)
    found = np.array([rings.off, inks, sizes, mixed, long, signed, ruled])
    usual = [_OFF, _INKS, _SIZES, _MIXED, _LONG, _SIGNED, _RULED]
    others = float(((found / usual) ** 2).sum())
    return others + cornered**2, others + float(hexagons) ** 2


def _outline(outline: Array, described: bool) -> tuple[float, float, float]:
    """What outlines (N, rays) [px] depart by from ellipses: in two periods [px], and in more over the usual.

    The last figure is what hexagons with a radius of 1 px depart by over the usual.
    """
    periods = np.fft.rfft(outline, axis=1)[:, 2 : _RAYS // 2] / _RAYS
    power = np.median(np.abs(periods) ** 2, axis=0)
    long = np.sqrt(max(power[0] - power[1:].mean(), 0.0))  # noise is alike in all
    corners = periods[:, 1:].mean(axis=0)
    noise = np.sqrt((np.abs(periods[:, 1:] - corners) ** 2).mean(axis=0) / len(periods))
    usual = np.hypot(2 * noise, _CORNERED_DRAWN if described else _CORNERED)
    return float(long), float((np.abs(corners) / usual).max()), 1 / (_HEXAGON**2 * float(usual[_HEXAGON - 3]))


def _misfit(light: Array, at: Array) -> float:
    """Departure (rms) of the light at distances (n,) from that of one blurred edge, or of two of a ring."""
    slope, between = np.diff(light), 0.5 * (at[1:] + at[:-1])
    steepest = max(float(np.abs(slope).max()), 1e-9)
    blur = max(float(np.ptp(light)), 1e-9) * (at[1] - at[0]) / (np.sqrt(2 * np.pi) * steepest)
    edges = sorted((slope, -slope), key=lambda one: -float(one.max()))
    places = [_peak(between, one) for one in edges]
    # The hole of a ring shows the paper, unless blur hides it; and a sharpened edge overshoots.
    least = 0.0 if min(abs(places[0] - places[1]), *places) < _NEAR * blur else _HOLE
    best = np.inf
    for share in _BLURS:
        steps = [erf_and_density((at - place) / (share * blur))[0] for place in places]
        for some in (steps[:1], steps):
            columns = np.stack([np.ones_like(at), *some], axis=-1)
            known = np.linalg.lstsq(columns, light, rcond=None)[0]
            if len(some) == 1 or known[1] * known[2] < -least * known[1] ** 2:
                best = min(best, float(np.sqrt(((light - columns @ known) ** 2).mean())))
    return best


def _peak(at: Array, values: Array) -> float:
    """Place of the greatest value, by a parabola through it and its neighbours."""
    k = int(np.clip(values.argmax(), 1, len(values) - 2))
    before, here, after = values[k - 1 : k + 2]
    bend = max(2 * here - before - after, 1e-9)
    return float(at[k] + np.clip(0.5 * (after - before) / bend, -1, 1) * (at[1] - at[0]))


def _ruled(rings: _Rings, clear: NDArray[np.bool_], places: Array) -> float:
    """Greatest change of the mean light in `clear` rings between the marks, beyond what noise makes of it.

    It changes by the angle, or is another one beside every second mark. Only the light within the board
    counts, and not its slope, nor that all marks are long.
    """
    if not clear.any():
        return 0.0
    levels, at = rings.levels[:, clear], places[:, None, None] + rings.shift[clear]
    within = ((at >= places.min(axis=0)) & (at <= places.max(axis=0))).all(axis=-1)
    usual = np.median(levels, axis=0)
    levels = np.where(within, levels, usual)
    # Numbers may label a few of the marks.
    odd = np.abs(levels - usual).max(axis=(1, 2))
    plain = odd <= np.quantile(odd, 1 - _LABELLED)
    levels, (x, y) = levels[plain], np.rint(places[plain] - places[0]).astype(int).T
    smooth = np.fft.rfft(levels.mean(axis=0), axis=1)
    smooth[:, 3:] = 0
    levels -= np.fft.irfft(smooth, _RAYS, axis=1)
    # Lines between some of the marks are no noise.
    noise = np.sqrt(np.median(levels.var(axis=0)))
    second = (x if rings.apart < _STAGGERED else (x + y) // 2) % 2 + 2 * (y % 2)
    some = [levels, *(levels[second == k] for k in np.unique(second))]
    away = (np.abs(one.mean(axis=0)) - _SURE * noise / np.sqrt(len(one)) for one in some)
    return float(np.max(list(away), initial=0.0))


_MOST, _FEWEST = 60, 2  # squares of a colour that are examined
_TO_SIDES = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
_TO_CORNERS = np.array([[1, 1], [-1, 1], [1, -1], [-1, -1]])
_BEYOND = 10  # steps
_DEPTH = np.linspace(-0.25, 0.5, 3 * _BEYOND + 1)  # [squares] within a side; its place is that of `_BEYOND`
_ON_RAYS = weights_within(
    (0.5 + np.concatenate([_TO_SIDES, _TO_CORNERS])[:, None] * (0.5 - _DEPTH[:, None])).reshape(-1, 2)
)
_CENTRE = weights_within(0.5 + 0.15 * np.concatenate([[[0, 0]], _TO_SIDES, _TO_CORNERS]))
_FLAT = 18  # steps from which a square has one level: 0.2 of it
# Greatest loss at the corners on the diagonal: squares, and px. Chessboards lose at most 0.02, circles 0.13.
_ROUNDED, _ROUNDED_PX = 0.025, 0.5
# Greatest difference of the places of the edges along both axes, in squares (0.0025 in 180 rendered boards,
# 0.007 in photographs; shifted rows 0.014 and more) and in px, beyond this share of the difference of the
# widths of the blur, by which overexposed light spreads.
_UNEVEN, _UNEVEN_PX, _SPREAD = 0.01, 0.1, 0.3
# Greatest spread of a square of one level, over the contrast: 0.04 in rendered and photographed chessboards,
# and 0.1 and more on boards with markers.
_LEVEL = 0.07


def are_squares(light: Image, pixels: Array, dark: int) -> bool:
    """Whether marks between vertices (rows, cols, 2) are squares; `dark` is that of `Grid`."""
    every = [(quads, own) for quads, own in _squares(light, pixels, dark) if len(own) >= _FEWEST]
    plain = all(_is_plain(own) for _, own in every)
    return len(every) < 2 or all(_meet(quads, own, plain) for quads, own in every)


def are_plain(light: Image, pixels: Array, dark: int) -> bool:
    """Whether most squares of either colour are of one level, compared with the contrast of the board."""
    return all(_is_plain(own) for _, own in _squares(light, pixels, dark))


def _is_plain(own: Array) -> bool:
    # Means of some samples are hardly noisy.
    parts = own[..., _FLAT:-1].reshape(len(own), -1, 6).mean(axis=2)
    return not len(own) or float(np.median(parts.std(axis=1))) < _LEVEL


def _squares(light: Image, pixels: Array, dark: int) -> list[tuple[Array, Array]]:
    """Squares (N, 4, 2) of each colour, and the share of their own level (N, 8, depths) on rays outwards.

    The share is 0 where they have the level of their neighbours, as the light changes over the board.
    """
    quads = squares_of(pixels)
    known = np.isfinite(quads).all(axis=(2, 3))
    row, col = np.nonzero(known)
    quads = quads[row, col]
    centre, beside = np.zeros((2, known.shape[0] + 2, known.shape[1] + 2))
    beside[1:-1, 1:-1] = known
    centre[row + 1, col + 1] = interpolate(light, _CENTRE @ quads).mean(axis=1)
    total, count = (x[:-2, 1:-1] + x[2:, 1:-1] + x[1:-1, :-2] + x[1:-1, 2:] for x in (centre, beside))
    level = centre[row + 1, col + 1]
    step = level - (total / np.maximum(count, 1))[row, col]
    result = []
    for colour in (0, 1):
        some = np.flatnonzero((row + col + dark) % 2 == colour)
        some = some[:: -(-len(some) // _MOST) or 1]
        away = interpolate(light, _ON_RAYS @ quads[some]) - level[some, None]
        own = 1 + away / np.where(step[some] == 0, np.inf, step[some])[:, None]
        result.append((quads[some], own.reshape(len(some), -1, len(_DEPTH))))
    return result


def _meet(quads: Array, own: Array, plain: bool) -> bool:
    """Whether squares (N, 4, 2) of one colour have sharp corners, and (if `plain`) like gaps both ways."""
    shares = np.median(own, axis=0)
    axes = shares[:4].reshape(2, 2, -1).mean(axis=1)
    step = _DEPTH[1] - _DEPTH[0]
    edges = [float(np.interp(0.5, np.maximum.accumulate(axis), _DEPTH)) for axis in axes]
    blurs = step / np.maximum(np.diff(axes, axis=1).max(axis=1), 1e-9)
    uneven = plain * (abs(edges[1] - edges[0]) - _SPREAD * abs(blurs[1] - blurs[0]))
    side, corner = axes.mean(axis=0), shares[4:].mean(axis=0)[_BEYOND:]
    within, beyond = side[_BEYOND:], np.zeros(len(corner))
    beyond[: _BEYOND + 1] = side[_BEYOND::-1]
    expected = within**2 + beyond**2 - np.maximum(within + beyond - 1, 0) ** 2
    lost = float((expected - corner).sum() * step)
    along, down = quads[:, 1] - quads[:, 0], quads[:, 2] - quads[:, 0]
    area = np.abs(np.linalg.det(np.stack([along, down], axis=1)))
    longest = np.maximum(np.hypot(*along.T), np.hypot(*down.T))
    width = max(float(np.median(area / longest)), 1.0)  # of squares that are seen from the side, the height
    return lost < max(_ROUNDED, _ROUNDED_PX / width) and uneven < max(_UNEVEN, _UNEVEN_PX / width)

"""Read markers of which nothing is known: neither the dictionary nor the width of the border.

OpenCV finds the quadrangles that may be markers. Their cells are sampled for each size of a code, and
compared with the codes of all predefined dictionaries.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.markers.lattice import homographies, homography_at
from neurocal_cli.detection.markers.reading import USUAL, Marks, candidates, scales_of
from neurocal_cli.observations.markers import DICTIONARIES, code, code_count, correctable

_WITHIN = (-0.25, 0.0, 0.25)  # of a cell, where it is sampled
_WRONG_BORDER = 0.1  # greatest share of light cells in a border
_EXTREME = 0.2  # share of the darkest and of the lightest cells that give the levels
_CONTRAST = 12.0  # DN, least difference of these
_FEWEST = 2  # markers
_UNIT = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
# Samples of any marker: 16 along its rim, which is dark, and 6 x 6 within. They save the cells of others.
_RIM = 0.07  # of the marker's side, from its edge; half a cell of most codes
_ALONG = (np.arange(4) + 0.5) / 4
_AROUND = np.concatenate(
    [
        np.stack(np.broadcast_arrays(*one), axis=-1)
        for at in (_RIM, 1 - _RIM)
        for one in ((_ALONG, at), (at, _ALONG))
    ]
)
_INSIDE = np.stack(np.meshgrid(*2 * [(np.arange(6) + 0.5) / 6]), axis=-1).reshape(-1, 2)
_LIGHT_RIM = 0.5  # greatest share of light samples of a rim
_ENOUGH = 12  # markers at a scale after which no other is tried


def read_codes(grey: NDArray[np.uint8]) -> list[tuple[Marks, int]]:
    """Markers of each dictionary that has at least two in an image, and the width of their border [cells].

    A marker of one dictionary may look like one of another, so several dictionaries may be named.
    """
    best: list[tuple[Marks, int]] = []
    for scale in scales_of(grey):
        found = list(codes_in(grey, candidates(grey, scale)))
        if max((len(marks) for marks, _ in found), default=0) > max((len(one) for one, _ in best), default=0):
            best = found
        if best and max(len(marks) for marks, _ in best) >= _ENOUGH:
            break
    return best


def codes_in(grey: NDArray[np.uint8], corners: Array) -> Iterator[tuple[Marks, int]]:
    """Markers of each dictionary and border that has at least two within quadrangles (N, 4, 2)."""
    if not len(corners):
        return
    H = homographies(np.broadcast_to(_UNIT, corners.shape), corners)
    framed = _is_framed(grey, H)
    H, corners = H[framed], corners[framed]
    if not len(corners):
        return
    for border in (1, 2):
        for bits in sorted(set(DICTIONARIES.values())):
            light, good = _cells(grey, H, bits, border)
            if not good.any():
                continue
            which = np.flatnonzero(good)
            for dictionary in USUAL:
                if DICTIONARIES[dictionary] != bits:
                    continue
                number, turn = _matched(light[good], dictionary)
                k = np.flatnonzero(number >= 0)
                # The marker's first corner is that of the quadrangle to which the bits were turned.
                placed = [np.roll(corners[which[j]], -turn[j], axis=0) for j in k.tolist()]
                number, first = np.unique(number[k], return_index=True)
                if len(number) >= _FEWEST:
                    yield Marks(number, np.stack(placed)[first], dictionary), border


def numbers_in(light: NDArray[np.float32], corners: Array, dictionary: str, border: int) -> NDArray[np.int64]:
    """Numbers (N,) of the markers of a dictionary within quadrangles (N, 4, 2), clockwise; -1 for none."""
    if not len(corners):
        return np.zeros(0, dtype=np.int64)
    H = homographies(np.broadcast_to(_UNIT, corners.shape), corners)
    cells, good = _cells(light, H, DICTIONARIES[dictionary], border)
    return np.where(good, _matched(cells, dictionary)[0], -1)


def _is_framed(grey: NDArray[np.uint8], H: Array) -> NDArray[np.bool_]:
    """Whether the rims (N,) of quadrangles are mostly dark, as those of markers of any code are."""
    sampled = _sampled(grey, H, np.concatenate([_AROUND, _INSIDE]))
    low, high = _levels(sampled)
    light = sampled[:, : len(_AROUND)] > 0.5 * (low + high)[:, None]
    return np.asarray((light.mean(axis=1) <= _LIGHT_RIM) & (high - low > 0.5 * _CONTRAST))


def _sampled(grey: NDArray[np.uint8] | NDArray[np.float32], H: Array, places: Array) -> Array:
    """Grey levels (N, K) at places (K, 2) of each quadrangle."""
    pixels = homography_at(H, np.broadcast_to(places, (len(H), *places.shape))).astype(np.float32)
    with np.errstate(invalid="ignore"):
        nowhere = np.nan_to_num(pixels, nan=-1.0, posinf=-1.0, neginf=-1.0)
    sampled = cv2.remap(grey, nowhere, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
    return np.asarray(sampled, dtype=float).reshape(len(H), len(places))


def _levels(grey: Array) -> tuple[Array, Array]:
    """Dark and light level (N,) of the samples (N, K) of markers."""
    ordered = np.sort(grey, axis=1)
    some = max(1, round(_EXTREME * grey.shape[1]))
    return ordered[:, :some].mean(axis=1), ordered[:, -some:].mean(axis=1)


def _cells(
    grey: NDArray[np.uint8] | NDArray[np.float32], H: Array, bits: int, border: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Light cells (N, bits, bits) of codes, and (N,) whether the border is dark."""
    side = bits + 2 * border
    ticks = (np.arange(side)[:, None] + 0.5 + np.array(_WITHIN)).ravel() / side
    places = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    sampled = _sampled(grey, H, places)
    n = len(_WITHIN)
    level = sampled.reshape(len(H), side, n, side, n).mean(axis=(2, 4))
    low, high = _levels(level.reshape(len(H), -1))
    light = level > 0.5 * (low + high)[:, None, None]
    inner = light[:, border:-border, border:-border]
    around = side * side - bits * bits
    wrong = light.sum(axis=(1, 2)) - inner.sum(axis=(1, 2))
    return inner, (wrong <= _WRONG_BORDER * around) & (high - low > _CONTRAST)


def _matched(light: NDArray[np.bool_], dictionary: str) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Numbers (N,) of the markers of a dictionary with these light cells, -1 for none, and quarter turns."""
    known, most = _known_codes(dictionary)
    turned = np.stack([np.rot90(light, turn, axes=(1, 2)) for turn in range(4)])
    signs = np.where(turned, np.float32(1), np.float32(-1)).reshape(4, len(light), -1)
    agree = signs @ known.T  # cells less twice the wrong ones
    nearest = agree.argmax(axis=2)
    agreed = np.take_along_axis(agree, nearest[..., None], axis=2)[..., 0]
    turn = agreed.argmax(axis=0)
    every = np.arange(len(light))
    close = agreed[turn, every] >= known.shape[1] - 2 * most
    return np.where(close, nearest[turn, every], -1).astype(np.int64), turn


@lru_cache
def _known_codes(dictionary: str) -> tuple[NDArray[np.float32], int]:
    """(M, bits^2) cells of the upright codes, 1 for light and -1 for dark, and how many may be wrong."""
    dark = np.stack([code(dictionary, k)[1:-1, 1:-1] for k in range(code_count(dictionary))])
    signs = np.where(dark, np.float32(-1), np.float32(1)).reshape(len(dark), -1)
    return signs, correctable(dictionary) // 2

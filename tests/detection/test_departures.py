"""Departures of edges from the map of their board are divided between paper, local shifts and the edges."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.measuring import Departures, find_departures

NOISE = 0.01  # px


def departed(
    cols: int, rows: int, seed: int, paper: float = 0.0, shift: Callable[[Array], Array] | None = None
) -> tuple[Departures, Array, Array]:
    """What is found, the mean displacement of the ends of edges along these, and the shifts of edges."""
    rng = np.random.default_rng(seed)
    along_c = np.argwhere(np.ones((rows, cols - 1)))[:, ::-1]
    along_r = np.argwhere(np.ones((rows - 1, cols)))[:, ::-1]
    ends = np.concatenate([along_c[:, None] + [[0, 0], [1, 0]], along_r[:, None] + [[0, 0], [0, 1]]])
    crossing = np.arange(len(ends)) >= len(along_c)
    light = np.where(ends[:, 0].sum(axis=1) % 2 == 0, 1.0, -1.0)
    moved = rng.normal(0, paper, (rows, cols, 2))[ends[..., 1], ends[..., 0]]  # (E, 2, 2) of both ends
    across = np.where(crossing, 0, 1)
    w = np.take_along_axis(moved, across[:, None, None], axis=2)[..., 0]
    q = np.zeros(len(ends)) if shift is None else shift(ends.mean(axis=1))
    departure = light * w.mean(axis=1) + q + rng.normal(0, NOISE, len(ends))
    tilt = light * (w[:, 1] - w[:, 0]) / 2
    found = find_departures(
        ends, light, departure, tilt, np.full(len(ends), NOISE**2), np.ones(len(ends), dtype=bool)
    )
    return found, np.take_along_axis(moved, (1 - across)[:, None, None], axis=2).mean(axis=(1, 2)), q


def rms(x: Array) -> float:
    return float(np.sqrt((x**2).mean()))


def glow(place: Array) -> Array:
    """A light that shines on a part of the board."""
    return np.asarray(0.05 * np.exp(-0.5 * ((place - [6, 2]) ** 2).sum(axis=1) / 1.5**2))


def test_shifts_by_light_are_told_from_the_paper() -> None:
    found, _, shift = departed(9, 6, 0, paper=0.02, shift=glow)
    assert rms(found.shift - shift) < 0.6 * rms(shift)
    assert 0.5 < ((found.shift - shift) ** 2 / found.shift_variance).mean() < 2


def test_displaced_vertices_are_no_shifts() -> None:
    found, along, _ = departed(9, 6, 1, paper=0.05)
    assert rms(found.shift) < 0.01
    assert rms(found.along - along) < 0.8 * rms(along)
    assert found.counted.min() == 2  # at the board's corners
    assert found.counted.max() == 4


def test_large_boards_are_divided() -> None:
    found, _, shift = departed(24, 12, 2, paper=0.02, shift=glow)
    assert rms(found.shift - shift) < 0.7 * rms(shift)


def test_no_edge_departs_if_none_is_good() -> None:
    ends = np.array([[[0, 0], [1, 0]], [[0, 0], [0, 1]]])
    nothing = np.zeros(2)
    found = find_departures(ends, np.ones(2), nothing, nothing, np.ones(2), np.zeros(2, dtype=bool))
    assert not found.along.any()
    assert not found.counted.any()

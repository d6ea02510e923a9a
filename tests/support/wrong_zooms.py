"""Zoom lenses whose data are wrong in the ways such data go wrong; none may end quietly as good.

Each entry spoils a smooth lens at 5 x 3 settings, 640 x 480 px with 0.15 px of noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from simulated_zoom import see

from neurocal_cli.calibration.zoom.fit import fit_lens
from neurocal_cli.calibration.zoom.judgement import judge_lens
from neurocal_cli.calibration.zoom.settings import LensPoints
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import NeurocalError
from neurocal_cli.observations.points import Correspondences
from support.zoom_laws import POSE, SIZE, THETA, grid, seen, truth

TOPOLOGIES = ((0, 1), (0, 2))
_ONE = 7  # the setting that is spoilt alone, in the middle of the range


def good() -> LensPoints:
    return seen("c", grid(5, 3), seed=1, side=5)


def outcome(points: LensPoints) -> tuple[str, tuple[str, ...]]:
    """What becomes of a lens: "refused", "good", "usable" or "poor", and why."""
    try:
        verdict = judge_lens(fit_lens(points, distortion="none", topologies=TOPOLOGIES))
    except NeurocalError as error:
        return "refused", (str(error),)
    assert verdict is not None
    return verdict.word, verdict.reasons


def _changed(
    change: Callable[[Correspondences, Array], dict[str, Array]],
    rename: Callable[[Array, Array], Array] = lambda settings, at: settings,
) -> LensPoints:
    """The good lens with its points, or the settings (N, 2) of its rows, changed."""
    lens = good()
    at = lens.point_setting
    settings = rename(lens.settings[at].copy(), at)
    return LensPoints.grouped(
        replace(lens.points, **change(lens.points, at)), dict(zip(lens.controls, settings.T, strict=True))
    )


def _same(points: Correspondences, at: Array) -> dict[str, Array]:
    return {}


def another_zoom(settings: Array, at: Array) -> Array:
    settings[at == _ONE, 0] += 250
    return settings


def two_exchanged(settings: Array, at: Array) -> Array:
    one, two = settings[at == 4][0].copy(), settings[at == 10][0].copy()
    settings[at == 4], settings[at == 10] = two, one
    return settings


def shuffled(settings: Array, at: Array) -> Array:
    order = np.random.default_rng(3).permutation(at.max() + 1)
    first = np.array([settings[at == k][0] for k in range(at.max() + 1)])
    return first[order][at]


def inches(points: Correspondences, at: Array) -> dict[str, Array]:
    return {"world": np.where((at == _ONE)[:, None], points.world / 25.4, points.world)}


def half_size(points: Correspondences, at: Array) -> dict[str, Array]:
    return {"pixels": np.where((at == _ONE)[:, None], points.pixels / 2, points.pixels)}


def target_moved(points: Correspondences, at: Array) -> dict[str, Array]:
    return {"world": np.where((at >= 8)[:, None], points.world + np.array([0.0, 6.0, 0.0]), points.world)}


def noisy(points: Correspondences, at: Array) -> dict[str, Array]:
    noise = 8 * np.random.default_rng(4).normal(size=points.pixels.shape)
    return {"pixels": points.pixels + np.where((at == _ONE)[:, None], noise, 0.0)}


def of_a_part(factor: float, jump: tuple[float, float]) -> LensPoints:
    """A third of the settings, in no order, has another focal length or image centre."""
    settings = grid(5, 3)
    parameters = truth("c", settings) | {"k1": np.zeros(len(settings))}
    part = np.random.default_rng(2).permutation(len(settings)) % 3 == 1
    for name in ("alpha_u", "alpha_v"):
        parameters[name] = parameters[name] * np.where(part, factor, 1.0)
    for name, shift in zip(("u0", "v0"), jump, strict=True):
        parameters[name] = parameters[name] + np.where(part, shift, 0.0)
    return see(parameters, settings, POSE, THETA, SIZE, 5, 0.15, np.random.default_rng(1))


def pairing(points: Correspondences, at: Array) -> dict[str, Array]:
    return {"world": np.where((at == _ONE)[:, None], np.roll(points.world, 1, axis=0), points.world)}


# What a reason has to say of each.
WRONG: dict[str, tuple[Callable[[], LensPoints], str]] = {
    "one setting under the name of another zoom": (lambda: _changed(_same, another_zoom), "left out|setting"),
    "two settings exchanged": (lambda: _changed(_same, two_exchanged), "2 of 15 settings .* left out"),
    "settings in another order": (lambda: _changed(_same, shuffled), "settings|noise floor"),
    "the points of one setting in inches": (
        lambda: _changed(inches),
        "settings.* setting08: .* closer together .* inches and millimetres mixed",
    ),
    "the image of one setting at half size": (lambda: _changed(half_size), "left out|setting"),
    "the target moved half way": (lambda: _changed(target_moved), "noise floor|moved"),
    "one setting with wrong pixels": (lambda: _changed(noisy), "left out"),
    "a teleconverter at a third of the settings": (lambda: of_a_part(1.4, (0.0, 0.0)), "noise floor"),
    "a lens refitted for a third of the settings": (
        lambda: of_a_part(1.0, (4.0, -3.0)),
        "noise floor",
    ),
    "one setting with points in wrong order": (lambda: _changed(pairing), "left out|setting"),
}

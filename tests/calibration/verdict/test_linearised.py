"""The linearised effects are what the causes do to the pixels, and the contest's bookkeeping holds."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.places import PROJECT
from support.targets import board, photographed

from neurocal_cli import Correspondences
from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.problem import normalised
from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.calibration.verdict import effects
from neurocal_cli.calibration.verdict.contest import _held
from neurocal_cli.calibration.verdict.effects import common
from neurocal_cli.calibration.verdict.findings import LEVEL
from neurocal_cli.calibration.verdict.linearised import Effect, Linearised, Seen, linearised
from neurocal_cli.calibration.verdict.rival import Estimate, Rival, estimates, including
from neurocal_cli.calibration.verdict.rivals import EFFECTS, RIVALS
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState

SIZE = (1280, 960)


def exact() -> tuple[Correspondences, CameraState]:
    """Pixels of a pinhole without noise, and the camera with its poses [px]."""
    points, truth = photographed("flat", 3, 8, 0.0, sigma=0.0, k=(0.0, 0.0))
    K = truth.K
    entries = np.array([[K[0, 0], K[0, 1], K[1, 1], K[0, 2], K[1, 2]]])
    return points, CameraState(entries, truth.R, truth.t)


def at(points: Correspondences, state: CameraState, free: int = 0) -> tuple[Linearised, Views, CameraState]:
    """Linearised with this camera, and poses that are fitted to the points."""
    views = arrange(points)
    some = np.arange(5) < free
    there = adjust(views.batches, normalised(state, views), some, True, 20).state
    return linearised(minimum(views, there, some), EFFECTS, SIZE), views, there


def minimum(views: Views, there: CameraState, free: NDArray[np.bool_]) -> Minimum:
    """A camera that is linearised, by the points themselves."""
    return Minimum(views, there, np.zeros(0), free, free_poses=True)


def left(lin: Linearised, effect: Effect, amounts: Array) -> float:
    """Rms of the residuals after a step along an effect, over that before."""
    step = np.zeros((lin.views.n_views, lin.width))
    before = lin.residuals(step)
    step[:, lin.columns[effect]] = amounts
    return float(np.sqrt((lin.residuals(step) ** 2).sum() / (before**2).sum()))


def with_pixels(points: Correspondences, by: Array) -> Correspondences:
    return replace(points, pixels=points.pixels + by)


def test_all_causes_have_the_same_evidence_in_metres_and_millimetres() -> None:
    points, state = exact()
    view = points.view_index
    x = (state.R[view] @ points.world[..., None])[..., 0] + state.t[view]
    off = points.pixels - state.entries[0, 3:]  # rays that lean meet the axis up to 30 mm away
    moved = 100.0 * off * ((x[:, :2] / x[:, 2:]) ** 2).sum(axis=1, keepdims=True) / x[:, 2:]
    points = with_pixels(points, moved + np.random.default_rng(0).normal(0, 0.1, points.pixels.shape))
    found = []
    for scale in (1.0, 1e-3):
        world, there = scale * points.world, replace(state, t=scale * state.t)
        lin, _, _ = at(replace(points, world=world), there, 5)
        found.append({one.rival.cause: one.evidence for one in estimates(lin, lin.spare, RIVALS, -np.inf)})
    assert "rays that do not meet in one point" in found[0]
    assert found[0] == pytest.approx(found[1], abs=1e-3)


def test_a_bend_takes_the_residuals_of_a_bent_board_away() -> None:
    points, state = exact()
    given = board() - board().mean(axis=0)
    x, y = given[:, :2].T / np.abs(given[:, 0]).max()
    heights = np.array([0.01, -0.02, 0.015, 0.0, 0.01, 0.0, -0.01])
    z = (
        sum(h * x**i * y**j for h, (i, j) in zip(heights, effects.BENDS, strict=True))
        * np.abs(given[:, 0]).max()
    )
    bent = board() + np.outer(z, [0, 0, 1])
    X = (state.R @ bent.T).swapaxes(1, 2) + state.t[:, None]
    pixels = X[..., :2] / X[..., 2:] * state.entries[0, [0, 2]] + state.entries[0, 3:]
    lin, *_ = at(replace(points, pixels=pixels.reshape(-1, 2)), state)
    assert lin.board is not None
    # The axes of the board may point the other way.
    flips = [np.array([su**i * sv**j for i, j in effects.BENDS]) for su in (1, -1) for sv in (1, -1)]
    assert min(left(lin, effects.bends, s * f * heights) for f in flips for s in (1, -1)) < 0.05
    assert left(lin, effects.stretch, np.array([0.01, 0.01])) > 0.5


@pytest.mark.parametrize("axis", [0, 1])
def test_a_cut_takes_the_displacement_away(axis: int) -> None:
    points, state = exact()
    half = (points.pixels[:, axis] > (SIZE[axis] - 1) / 2)[:, None]
    lin, views, _ = at(with_pixels(points, np.where(half, [2.0, -1.0], 0.0)), state)
    (cut,) = (r.effect for r in RIVALS if r.cause == f"a cut along {'vu'[axis]}")
    assert cut is not None
    assert left(lin, cut, np.array([2.0, -1.0]) / views.pixel_scale) < 0.3  # points at the cut


def test_rows_that_are_read_while_the_camera_turns() -> None:
    points, state = exact()
    rows = (points.pixels[:, 1:] - (SIZE[1] - 1) / 2) / SIZE[1]
    lin, *_ = at(with_pixels(points, rows * [3.0, 2.0]), state)
    assert left(lin, effects.turning, np.array([3.0, 2.0]) / SIZE[1]) < 0.05


def test_blocks_of_a_codec() -> None:
    points, state = exact()
    lin, views, _ = at(with_pixels(points, 0.2 * np.cos(2 * np.pi * (points.pixels + 0.5) / 8)), state)
    (codec,) = (r.effect for r in RIVALS if r.cause == "a video codec" and "8 px" in r.looks)
    assert codec is not None
    amounts = 0.2 / views.pixel_scale * np.array([1.0, 0.0, 1.0, 0.0])
    assert left(lin, codec, amounts) < 0.3  # the observed place, displaced, stands for the true one


def test_a_changed_camera_takes_its_residuals_away() -> None:
    points, state = exact()
    moved = replace(state, entries=state.entries + np.array([2.0, 0.0, 1.0, 3.0, -2.0]))
    lin, views, _ = at(points, moved)
    step = np.zeros((views.n_views, lin.width))
    before = lin.residuals(step)
    step[:, :5] = np.array([-2.0, 0.0, -1.0, -3.0, 2.0]) / views.pixel_scale
    assert np.sqrt((lin.residuals(step) ** 2).sum() / (before**2).sum()) < 0.05


def drifting() -> Linearised:
    points, state = exact()
    share = 1.0 + 0.01 * points.view_index / 7
    noise = 0.1 * np.random.default_rng(1).standard_normal(points.pixels.shape)
    pixels = state.entries[0, 3:] + (points.pixels - state.entries[0, 3:]) * share[:, None] + noise
    return at(replace(points, pixels=pixels), state, 5)[0]


def test_a_further_cause_is_told_with_what_it_changes_beside_the_first() -> None:
    points, state = exact()
    from_middle = np.linalg.norm(points.world - points.world.mean(axis=0), axis=1)
    pixels = state.entries[0, 3:] + (points.pixels - state.entries[0, 3:]) * (
        1.0 + 0.003 * (from_middle / from_middle.max())[:, None] ** 2
    )
    noise = 0.03 * np.random.default_rng(1).standard_normal(pixels.shape)
    in_blocks = 0.2 * np.cos(2 * np.pi * (points.pixels + 0.5) / 8)
    lens, codec, _ = _held(
        at(replace(points, pixels=pixels + noise + in_blocks), state, 5)[0], 1.0, RIVALS
    ).causes
    assert (lens.rival.cause, codec.rival.cause) == ("a lens that is too simple", "a video codec")
    assert abs(codec.camera[0]) < 0.3 * abs(lens.camera[0])


def of_cause(lin: Linearised, cause: str) -> Estimate:
    return next(one for one in estimates(lin, lin.spare, RIVALS) if one.rival.cause == cause)


def test_the_evidence_is_that_of_the_whole_system() -> None:
    """The same with a dense normal matrix of camera, poses and the rival's unknown."""
    lin = drifting()
    found = of_cause(lin, "a changing focal length")
    g = lin.R[:, :-1].swapaxes(1, 2) @ found.rival.steps_at(lin) * found.weights[:, None, None]
    kept = np.append(lin.free, lin.width)
    M = lin.R[:, kept[:, None], kept].sum(axis=0)
    S = float(
        (
            found.weights**2
            * (found.rival.steps_at(lin).T @ lin.R[:, :-1, :-1] @ found.rival.steps_at(lin))[:, 0, 0]
        ).sum()
    )
    by = g[:, kept, 0].sum(axis=0)
    whole = np.block([[M[:-1, :-1], by[:-1, None]], [by[None, :-1], np.array([[S]])]])
    right = np.append(M[:-1, -1], by[-1])
    whole[-1, -1] += found.noise / found.size**2
    step = np.linalg.solve(whole, right)
    before = M[-1, -1] - M[:-1, -1] @ np.linalg.solve(M[:-1, :-1], M[:-1, -1])
    after = M[-1, -1] - right @ step
    assert found.explained == pytest.approx(1 - after / before, rel=1e-3)
    assert found.amounts[0] == pytest.approx(step[-1], rel=1e-3)
    odds = (
        np.linalg.slogdet(whole)[1] - np.linalg.slogdet(M[:-1, :-1])[1] - np.log(found.noise / found.size**2)
    )
    assert found.evidence == pytest.approx(-0.5 * lin.spare * np.log(after / before) - 0.5 * odds, abs=0.01)
    assert found.amounts[0] == pytest.approx(0.01, rel=0.25)  # with noise


@pytest.mark.parametrize("cause", ["a changing focal length", "a zoom that moves"])
def test_what_is_included_is_explained(cause: str) -> None:
    lin = drifting()
    found = of_cause(lin, cause)
    after = including(lin, found)
    rest = estimates(after, after.spare, tuple(one for one in RIVALS if one.cause != cause))
    assert max(one.evidence for one in rest) < 4.0
    assert found.evidence > 20.0


def test_a_new_cause_is_a_rival_and_wins_where_it_is_the_cause() -> None:
    def keystone(seen: Seen) -> Array:
        """Rows get longer from the top of the image to its foot."""
        return seen.by_entries[:, 3:4] * (seen.pixels[:, None, None, 0] * seen.pixels[:, None, None, 1])

    new = Rival("a keystone", "-", "-", lambda told: ("", 0.0), RIVALS[0].limit, common, effect=keystone)
    points, state = exact()
    noise = 0.05 * np.random.default_rng(2).standard_normal(points.pixels.shape)
    u, v = ((points.pixels - (np.array(SIZE) - 1) / 2) / 1000).T
    views = arrange(with_pixels(points, np.column_stack([3.0 * u * v, 0 * u]) + noise))
    free = np.ones(5, dtype=bool)
    there = adjust(views.batches, normalised(state, views), free, True, 20).state
    lin = linearised(minimum(views, there, free), (*EFFECTS, keystone), SIZE)
    first, second = estimates(lin, lin.spare, (*RIVALS, new))[:2]
    assert first.rival is new
    assert first.evidence > second.evidence + LEVEL
    assert first.amounts[0] * views.pixel_scale == pytest.approx(
        3.0 * (views.pixel_scale / 1000) ** 2, rel=0.1
    )


def test_the_page_lists_all_causes() -> None:
    import sys

    sys.path.insert(0, str(PROJECT / "docs" / "tools"))
    import causes

    assert causes.table() in (PROJECT / "docs" / "reference" / "causes.md").read_text(encoding="utf-8")


def test_the_derivatives_of_many_points_are_never_held_all_at_once() -> None:
    points, state = exact()
    world, pixels, view = (np.concatenate(100 * [of]) for of in (points.world, points.pixels, points.view))
    many = Correspondences(world, pixels, view)
    views = arrange(many)
    there, free = normalised(state, views), np.ones(5, dtype=bool)
    tracemalloc.start()
    try:
        lin = linearised(minimum(views, there, free), EFFECTS, SIZE)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 0.5 * len(many) * 2 * (lin.width + 7) * 8

"""Points that were measured across their edges give one equation each, and standard deviations hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.edge_points import as_measured, edge_set, edges
from support.rigs import random_rig
from support.scenes import pinhole
from support.slow_cases import slow_but

from neurocal_cli import Correspondences, calibrate
from neurocal_cli.adjustment.common_noise import Noise, noise_of
from neurocal_cli.adjustment.residual_correlation import correlation
from neurocal_cli.adjustment.views import arrange, noise_model
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.lens_choice.straight_lines import find_lines
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.calibration.verdict.evidence import Evidence
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import InputError
from neurocal_cli.observations.measured_directions import (
    LEAST,
    equations,
    loosened,
    measured_part,
    rounded,
    unit,
)

NAMES = ("alpha_u", "alpha_v", "u0", "v0")


def sigmas(found: Calibration, camera: Intrinsics) -> list[float]:
    """Errors of the intrinsics in standard deviations."""
    return [(getattr(found.intrinsics, name) - getattr(camera, name)) / found.std[name] for name in NAMES]


def rms(values: object) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(values)))))


@pytest.mark.slow
@pytest.mark.parametrize("sets", [60])
def test_standard_deviations_of_midpoints_hold(sets: int) -> None:
    """And they hold, counting views, where places along the edges are taken for measurements of their own."""
    one_way, both_ways, disagreement = [], [], []
    for seed in range(sets):
        camera, points = edge_set(seed)
        found = pinhole(points, skew=False)
        one_way.append(sigmas(found, camera))
        both_ways.append(sigmas(pinhole(replace(points, across=None), skew=False, target="given"), camera))
        disagreement.append(Evidence(found).disagreement)
    assert 0.85 < rms(one_way) < 1.15
    assert 0.85 < rms(both_ways) < 1.25  # 2.0 and more for those of the normal matrix
    assert np.mean(disagreement) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize(
    ("distortion", "sets"), slow_but([("k1k2", 15)], [("k1k2", 15), ("k1k2", 50), ("plumb-line", 50)])
)
def test_standard_deviations_of_a_lens_hold(distortion: str, sets: int) -> None:
    errors = []
    for seed in range(sets):
        camera, points = edge_set(seed, 12, 0.05, (-0.2, 0.05))
        found = calibrate(points, skew=False, distortion=distortion, outliers="keep")
        k1, k2 = found.distortion[:2]
        errors.append([*sigmas(found, camera), (k1 + 0.2) / found.std["k1"], (k2 - 0.05) / found.std["k2"]])
    assert 0.85 < rms(errors) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("rigs", [30])
def test_standard_deviations_of_a_rig_hold(rigs: int) -> None:
    one_way, both_ways = [], []
    world, ends = edges()
    for seed in range(rigs):
        rng = np.random.default_rng(seed)
        scene = replace(random_rig(rng, "verging", 8), world=world)
        sides = [
            as_measured(scene.points(side), replace(scene, world=ends).points(side).pixels, 0.01, rng)
            for side in (0, 1)
        ]
        for kept, points in ((one_way, sides), (both_ways, [replace(p, across=None) for p in sides])):
            rig = calibrate_stereo(*points, skew=False, distortion="none", outliers="keep")
            kept.append([(rig.t[k] - scene.rig.t[k]) / rig.std[f"t_{axis}"] for k, axis in enumerate("xyz")])
    assert 1 - 1.1 / np.sqrt(rigs) < rms(one_way) < 1 + 1.1 / np.sqrt(rigs)  # 0.2 for thirty
    # The jackknife over pairs makes up for taking places along the edges for measurements of their own.
    assert 0.7 < rms(both_ways) < 1.5  # 2.0 and more for those of the normal matrix


@pytest.mark.slow
def test_the_level_of_the_noise_is_that_of_the_measurement() -> None:
    levels = [Evidence(pinhole(edge_set(seed)[1], skew=False)).contradiction for seed in range(20)]
    assert np.mean(levels) == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("sets", [40])
def test_no_lens_is_seen_where_there_is_none(sets: int) -> None:
    found = [calibrate(edge_set(seed)[1], skew=False) for seed in range(100, 100 + sets)]
    assert sum(one.distortion_model == "none" for one in found) >= 0.92 * sets - 1
    assert not any(len(one.rejected) for one in found)


@pytest.mark.parametrize("direction", ["along", "across"])
def test_a_point_that_is_shifted_along_its_edge_is_found_too(direction: str) -> None:
    _camera, points = edge_set(7)
    assert points.across is not None
    step = np.array(points.across)
    if direction == "along":
        step = step[:, ::-1] * [-1.0, 1.0]
    pixels = np.array(points.pixels)
    wrong = np.arange(40, 700, 93)
    pixels[wrong] += 6.0 * step[wrong]
    found = calibrate(replace(points, pixels=pixels), skew=False, distortion="none")
    clean = calibrate(points, skew=False, distortion="none")
    assert found.rejected.points is not None
    assert (np.sort(found.rejected.points.world, axis=0) == np.sort(points.world[wrong], axis=0)).all()
    assert len(clean.rejected) == 0
    assert rms(sigmas(found, clean.intrinsics)) < 1.0


def test_a_view_whose_edges_all_run_one_way_keeps_its_pose() -> None:
    """Nothing but the map tells where such a board is along its edges."""
    camera, points = edge_set(3)
    view = points.select(points.view_index == 0)
    one_way = view.select(np.asarray(view.world[:, 0] % 25 > 0))
    found, whole = (calibrate(some, type=3, intrinsics=camera) for some in (one_way, view))
    name = points.view_names[0]
    assert found.translations[name] == pytest.approx(whole.translations[name], rel=1e-3)
    assert found.views[name].std["t_x"] > 3 * whole.views[name].std["t_x"]
    assert found.rmse_px < 0.05


def test_residuals_beyond_the_measurements_count_both_ways() -> None:
    _, points = edge_set(1)
    assert points.covariance is not None
    assert points.across is not None
    rng = np.random.default_rng(0)
    n = unit(points.across)
    noise = {}
    for level in (0.5, 1.0, 3.0, 9.0):
        size = np.sqrt(level * (points.covariance[:, 0] + points.covariance[:, 2]))
        noise[level] = noise_of(
            points.covariance, (size * rng.normal(size=len(n)))[:, None] * n, points.across
        )
    assert noise[0.5].along == noise[1.0].along == LEAST
    assert LEAST < noise[3.0].along < 1.0
    assert noise[9.0] == Noise(1.0, 1.0)


def spread_out(seed: int, n: int = 50) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, 2, 2)) + 0.1 * np.eye(2)
    C = (a @ np.swapaxes(a, 1, 2)).reshape(n, 4)[:, [0, 1, 3]]
    across = rng.normal(size=(n, 2)) * 10 ** rng.uniform(-3, 3, (n, 1))
    across[::3] = 0.0
    return C, across


@given(st.integers(0, 1000), st.floats(1e-3, 1.0))
def test_what_a_point_says_across_its_edge_stays(seed: int, along: float) -> None:
    C, across = spread_out(seed)
    loose, n = loosened(C, across, along), unit(across)
    full, was = (c[:, [0, 1, 1, 2]].reshape(-1, 2, 2) for c in (loose, C))
    s = n[:, ::-1] * [-1.0, 1.0]

    def form(a: Array, M: Array, b: Array) -> Array:
        return np.asarray(np.einsum("ni,nij,nj->n", a, M, b))

    free = (across != 0).any(axis=1)
    assert form(n, full, n)[free] == pytest.approx(form(n, was, n)[free])
    assert form(s, full, s)[free] * along == pytest.approx(form(n, was, n)[free])
    assert form(n, full, s)[free] == pytest.approx(0.0, abs=1e-9 * float(loose.max()))
    assert (loose[~free] == C[~free]).all()
    assert equations(across, len(across), along).sum() == pytest.approx(
        2 * (~free).sum() + (1 + along) * free.sum()
    )


@given(st.integers(0, 1000))
def test_the_measured_part_is_a_projection(seed: int) -> None:
    _, across = spread_out(seed)
    errors = np.random.default_rng(seed).normal(size=across.shape)
    part = measured_part(errors, across)
    assert measured_part(part, across) == pytest.approx(part)
    assert (part * unit(across)).sum(axis=1) == pytest.approx((errors * unit(across)).sum(axis=1))
    assert (part[::3] == errors[::3]).all()


@given(st.integers(0, 1000))
def test_whitening_has_a_mean_square_of_one_for_each_equation(seed: int) -> None:
    C, across = spread_out(seed)
    weights, factors = noise_model(C, across)
    assert weights is not None
    assert factors is not None
    assert (factors**2).sum() == pytest.approx(equations(across, len(across)).sum())
    assert weights.mean() == pytest.approx(1.0)
    u00, u01, u11 = rounded(factors, across).T
    one_way = (across != 0).any(axis=1)
    assert (u01[one_way] == 0).all()
    assert (u00[one_way] == u11[one_way]).all()
    n = unit(across)
    seen = np.hypot(factors[:, 0] * n[:, 0] + factors[:, 1] * n[:, 1], factors[:, 2] * n[:, 1])
    assert u00[one_way] == pytest.approx(seen[one_way])


def test_neighbours_are_compared_across_edges_of_the_same_way() -> None:
    _, points = edge_set(2, n_views=12)
    views = arrange(points)
    rng = np.random.default_rng(5)
    assert abs(correlation(views, rng.normal(size=points.pixels.shape))) < 0.08
    x, y = (3 * views.pixels).T
    smooth = np.column_stack([np.sin(x + 2 * y), np.cos(2 * x - y)])
    assert correlation(views, smooth) > 0.8
    # What varies along the edges only was not measured.
    n = unit(points.across) if points.across is not None else smooth
    unseen = n[:, ::-1] * [-1.0, 1.0] * rng.normal(size=(len(n), 1))
    mixed = 0.1 * smooth + 100 * unseen
    assert correlation(views, mixed) == pytest.approx(correlation(views, smooth))


def test_lines_run_along_the_edges_of_their_points() -> None:
    _, points = edge_set(4)
    lines = find_lines(points)
    assert len(lines) == 8 * (6 + 9)
    assert points.across is not None
    for first, count in zip(lines.first, lines.counts, strict=True):
        rows = lines.row[first : first + count]
        chord = points.pixels[rows[-1]] - points.pixels[rows[0]]
        assert np.abs(points.across[rows] @ chord).max() < 0.1 * np.linalg.norm(chord)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_directions_must_be_finite(bad: float) -> None:
    across = np.ones((4, 2))
    across[2, 1] = bad
    with pytest.raises(InputError, match=r"row 3: the direction nu,nv .* finite"):
        Correspondences(np.zeros((4, 3)), np.zeros((4, 2)), across=across)


def test_no_direction_is_none() -> None:
    assert Correspondences(np.zeros((4, 3)), np.zeros((4, 2)), across=np.zeros((4, 2))).across is None
    with pytest.raises(InputError, match="across"):
        Correspondences(np.zeros((4, 3)), np.zeros((4, 2)), across=np.zeros((3, 2)))

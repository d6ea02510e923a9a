"""Views: sorted, normalised, flat or not, and the patterns drawn from them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.camera.geometry import Array, euler_to_rotation
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.network.network import patterns_of
from neurocal_cli.observations.points import Correspondences

COUNTS = (30, 7, 12)


def ragged(seed: int = 0, covariance: bool = False) -> Correspondences:
    """Three views whose rows are mixed."""
    rng = np.random.default_rng(seed)
    n = sum(COUNTS)
    label = rng.permutation(np.repeat(["a", "b", "c"], COUNTS))
    world = rng.uniform(-50, 50, (n, 3)) + np.array([1000.0, -300.0, 5.0])
    s = rng.uniform(0.1, 3, (n, 2))
    factor = np.column_stack([s[:, 0] ** 2, 0.4 * s[:, 0] * s[:, 1], s[:, 1] ** 2])
    return Correspondences(
        world, rng.uniform(0, 640, (n, 2)), label, covariance=factor if covariance else None
    )


def rows_of(views: Views, points: Correspondences) -> Array:
    return np.arange(len(points)) if views.order is None else views.order


def test_points_are_sorted_by_view_and_come_back_by_s1_and_s2() -> None:
    points = ragged()
    views = arrange(points)
    rows = rows_of(views, points)
    assert views.counts.tolist() == [int((points.view_index == k).sum()) for k in range(3)]
    assert views.index.tolist() == sorted(points.view_index)
    np.testing.assert_array_equal(points.view_index[rows], views.index)
    one = np.ones((len(points), 1))
    pixels = np.hstack([views.pixels, one]) @ views.S1.T
    np.testing.assert_allclose(pixels[:, :2], points.pixels[rows], rtol=1e-13)
    for k in range(3):
        mine = views.index == k
        normal = np.hstack([points.world[rows][mine], one[mine]]) @ views.S2[k].T
        np.testing.assert_allclose(normal[:, :3], views.local[mine], atol=1e-13)


def test_each_view_is_centred_and_scaled_by_itself_and_pixels_all_together() -> None:
    views = arrange(ragged())
    for k in range(3):
        local = views.local[views.index == k]
        assert np.abs(local.mean(axis=0)).max() < 1e-14
        assert np.abs(local).max() == pytest.approx(1)
    assert np.abs(views.pixels).max() == pytest.approx(1)


def test_rows_in_order_are_not_moved() -> None:
    points = ragged()
    ordered = points.select(np.argsort(points.view_index, kind="stable"))
    assert arrange(ordered).order is None


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.integers(0, 40), min_size=1, max_size=60),
    st.floats(-3, 3),
    st.floats(-3, 3),
    st.integers(1, 3),
)
def test_different_points_are_counted_in_any_pose_of_the_grid(
    cells: list[int], turn: float, scale: float, n_views: int
) -> None:
    grid = np.array([(c % 9, c // 9, 0.0) for c in cells]) * 10.0**scale
    world = np.tile(grid @ euler_to_rotation(0.3, turn, 1.0).T + 5.0, (n_views, 1))
    labels = np.repeat(np.arange(n_views), len(cells))
    views = arrange(Correspondences(world, np.arange(2.0 * len(world)).reshape(-1, 2), labels))
    assert views.distinct.tolist() == [len(set(cells))] * n_views


@pytest.mark.parametrize(
    ("thickness", "exactly", "nearly"),
    [(0.0, True, True), (1e-9, True, True), (1e-4, False, True), (0.01, False, True), (0.1, False, False)],
)
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_plane_is_told_in_any_pose_and_unit(
    thickness: float, exactly: bool, nearly: bool, scale: float
) -> None:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-1, 1, (50, 2)), thickness * rng.normal(size=50)])
    world = scale * (plane @ euler_to_rotation(0.5, 0.4, 1.0).T + 3.0)
    views = arrange(Correspondences(world, rng.uniform(0, 9, (50, 2))))
    assert views.exactly_flat.tolist() == [exactly]
    assert views.nearly_flat.tolist() == [nearly]
    # The principal axes are a rotation whose third column is the plane's normal.
    normal = views.basis[0][:, 2]
    assert np.linalg.det(views.basis[0]) == pytest.approx(1)
    if nearly:
        assert abs(normal @ euler_to_rotation(0.5, 0.4, 1.0)[:, 2]) == pytest.approx(1, abs=1e-3)


def test_weights_have_mean_1_and_whitening_is_a_factor_of_the_inverse_covariance() -> None:
    points = ragged(covariance=True)
    views = arrange(points)
    assert points.covariance is not None
    assert views.whitening is not None
    assert views.weights.mean() == pytest.approx(1)
    shared = None
    for row, (u00, u01, u11) in zip(rows_of(views, points), views.whitening, strict=True):
        suu, suv, svv = points.covariance[row]
        U = np.array([[u00, u01], [0.0, u11]])
        ratio = U.T @ U @ np.array([[suu, suv], [suv, svv]])
        shared = ratio[0, 0] if shared is None else shared
        np.testing.assert_allclose(ratio, shared * np.eye(2), atol=1e-12 * shared)


def test_a_common_factor_of_the_noise_changes_nothing() -> None:
    points = ragged(covariance=True)
    assert points.covariance is not None
    more = Correspondences(points.world, points.pixels, points.view, covariance=49 * points.covariance)
    one, two = arrange(points), arrange(more)
    np.testing.assert_allclose(one.weights, two.weights, rtol=1e-13)
    np.testing.assert_allclose(np.asarray(one.whitening), np.asarray(two.whitening), rtol=1e-13)


def test_covariances_on_the_edge_of_being_singular_stay_finite() -> None:
    suv = np.sqrt(2.0 * 3.0) * (1 - 1e-15)
    points = ragged()
    covariance = np.tile([2.0, suv, 3.0], (len(points), 1))
    views = arrange(Correspondences(points.world, points.pixels, points.view, covariance=covariance))
    assert np.isfinite(np.asarray(views.whitening)).all()


@pytest.mark.parametrize("random", [False, True])
@pytest.mark.parametrize("most", [4, 10, 100])
def test_patterns_are_each_views_own_points_from_all_its_stretches(most: int, random: bool) -> None:
    points = ragged()
    views = arrange(points)
    chosen = np.array([2, 0])
    rng = np.random.default_rng(0) if random else None
    patterns = patterns_of(views, chosen, False, most, rng)
    width = min(most, int(views.counts[chosen].max()))
    assert patterns.weights.shape == (2, width)
    for k, view in enumerate(chosen):
        real = patterns.weights[k] > 0
        count = int(views.counts[view])
        assert real.sum() == min(count, width)
        own = views.local[views.index == view]
        drawn = patterns.inputs[k, real, :3]
        rows = np.array([int(np.flatnonzero((own == point).all(axis=1))[0]) for point in drawn])
        assert (views.pixels[views.index == view][rows] == patterns.targets[k, real, :2]).all()
        # A stretch that ends within a row shares it with the next one, so a random draw may repeat it.
        assert (np.diff(rows) >= (0 if random else 1)).all()
        assert (
            np.abs(rows + 0.5 - (np.arange(len(rows)) + 0.5) * max(count / width, 1)).max() <= count / width
        )


def test_flat_patterns_are_coordinates_in_the_plane() -> None:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-1, 1, (20, 2)), np.zeros(20)]) @ euler_to_rotation(0.5, 0.4, 1.0).T
    views = arrange(Correspondences(plane, rng.uniform(0, 9, (20, 2))))
    inputs = patterns_of(views, np.array([0]), True, 100).inputs[0]
    assert inputs.shape == (20, 3)
    back = np.column_stack([inputs[:, :2], np.zeros(20)]) @ views.basis[0].T
    np.testing.assert_allclose(back, views.local, atol=1e-14)


def test_a_subset_holds_the_same_views_as_before() -> None:
    views = arrange(ragged(covariance=True))
    part = views.subset(np.array([0, 2]))
    assert part.names == (views.names[0], views.names[2])
    for new, old in ((0, 0), (1, 2)):
        mine, was = part.index == new, views.index == old
        np.testing.assert_array_equal(part.local[mine], views.local[was])
        np.testing.assert_array_equal(part.pixels[mine], views.pixels[was])
        np.testing.assert_array_equal(np.asarray(part.whitening)[mine], np.asarray(views.whitening)[was])
        np.testing.assert_array_equal(part.S2[new], views.S2[old])
    assert part.first.tolist() == [0, views.counts[0]]


def test_equal_pixels_are_refused() -> None:
    with pytest.raises(DegenerateGeometryError, match="all pixels u,v are the same; check the columns"):
        arrange(Correspondences(np.eye(3), np.ones((3, 2))))

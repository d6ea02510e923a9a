"""PointBatches hold every point once, of one view each, whatever the sizes of the views."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from neurocal_cli.adjustment.views import PointBatches, batches_of
from neurocal_cli.camera.geometry import Array

counts_of = st.lists(
    st.one_of(st.integers(1, 9), st.sampled_from([511, 512, 513, 1500])), min_size=1, max_size=7
)


def laid(
    counts: list[int], whitened: bool, seed: int = 0
) -> tuple[PointBatches, Array, Array | None, NDArray[np.intp]]:
    """PointBatches of points whose first coordinate is their number."""
    rng = np.random.default_rng(seed)
    n = sum(counts)
    view = rng.permutation(np.repeat(np.arange(len(counts)), counts))
    local = np.column_stack([np.arange(n), rng.normal(size=(n, 2))])
    whitening = rng.uniform(0.5, 2, (n, 3)) if whitened else None
    return batches_of(local, local[:, :2], whitening, view, len(counts)), local, whitening, view


@settings(max_examples=40, deadline=None)
@given(counts_of, st.booleans())
def test_every_point_lies_in_one_tile_of_its_view_and_padding_weighs_nothing(
    counts: list[int], whitened: bool
) -> None:
    batches, local, whitening, view = laid(counts, whitened)
    n = batches.local.shape[2]
    assert batches.counts.tolist() == counts
    assert batches.view[batches.first].tolist() == list(range(len(counts)))
    factors = batches.whitening
    if factors is None:
        assert not whitened
        assert len(batches.view) * n == len(local)
        factors = np.ones((len(batches.view), 3, n))
    real = factors[:, 0] > 0
    assert real.sum() == len(local)
    numbers = batches.local[:, 0].astype(int)
    assert sorted(numbers[real]) == list(range(len(local)))
    assert (view[numbers] == batches.view[:, None]).all()  # padding as well: a point of the same view
    np.testing.assert_array_equal(np.swapaxes(batches.local, 1, 2), local[numbers])
    np.testing.assert_array_equal(np.swapaxes(batches.pixels, 1, 2), local[numbers][..., :2])
    assert (np.swapaxes(factors, 1, 2)[~real] == 0).all()
    expected = np.array([1.0, 0.0, 1.0]) if whitening is None else whitening[numbers[real]]
    if batches.whitening is not None:
        np.testing.assert_array_equal(np.swapaxes(factors, 1, 2)[real], expected + np.zeros((len(local), 3)))


@settings(max_examples=40, deadline=None)
@given(counts_of)
def test_sums_over_tiles_are_sums_over_views(counts: list[int]) -> None:
    batches, *_ = laid(counts, True)
    ones = np.ones((len(batches.view), 2, 2))
    expected = np.bincount(batches.view)[:, None, None] * np.ones((2, 2))
    np.testing.assert_array_equal(batches.sum_by_view(ones), expected)


@settings(max_examples=40, deadline=None)
@given(counts_of)
def test_chunks_cover_all_tiles_once(counts: list[int]) -> None:
    batches, *_ = laid(counts, False)
    covered = np.concatenate([np.arange(len(batches.view))[chunk] for chunk in batches.chunks()])
    assert covered.tolist() == list(range(len(batches.view)))


def test_views_of_one_size_need_no_padding_and_keep_the_order() -> None:
    batches, local, _, view = laid([54] * 5, False)
    assert batches.whitening is None
    assert batches.local.shape == (5, 3, 54)
    for k in range(5):
        assert batches.local[k, 0].tolist() == local[view == k, 0].tolist()


@pytest.mark.parametrize("counts", [[20_000, 4, 5, 6, 7, 8], [7] * 200 + [5000]])
def test_ragged_views_cost_little_padding(counts: list[int]) -> None:
    batches, *_ = laid(counts, False)
    assert len(batches.view) * batches.local.shape[2] < 2 * sum(counts) + 1000

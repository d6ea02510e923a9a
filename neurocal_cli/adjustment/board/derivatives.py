"""Derivatives of one camera's observations of a target, by poses, bends of views and target points.

Normal matrices have the columns of `reprojection`. With a bend in each view, they have three more columns,
for its coefficients, before that of the residual.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.reprojection import POSE, POSE_COLUMNS, derivatives
from neurocal_cli.adjustment.views import PointBatches
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.target import N_SHAPES


def linearised(
    batches: PointBatches, state: CameraState, scale: Array, label: NDArray[np.intp], shapes: Array | None
) -> Iterator[tuple[slice, Array, Array]]:
    """Chunks of batches, their rows of derivatives and residuals, and the derivatives by the points.

    `scale` (V,) is S2 of each view, and `label` (T, n) is the index of the target point in each slot, or a
    single row that holds for all batches. With bends (`shapes`), the rows have the derivatives by each view's
    bend. They are overwritten in the next chunk.
    """
    buffer = batches.memory(12 + len(state.k))
    for chunk in batches.chunks():
        view = batches.view[chunk]
        part = buffer[: len(view)]
        derivatives(batches, chunk, state, part[:, :-1])
        # d Xc = R dM / S2, and the derivative by tau is that by the point in front of the camera.
        turn = np.swapaxes(state.R[view] / scale[view][:, None, None], 1, 2)
        by_tau = part[:, POSE.start + 3 : POSE.stop]
        by_point = (turn @ by_tau.reshape(len(view), 3, -1)).reshape(by_tau.shape)  # (T, 3, 2, n)
        if shapes is not None:
            of_points = shapes[label if len(label) == 1 else label[chunk]]  # (T, n, 3, 3) or (1, n, 3, 3)
            along = np.ascontiguousarray(np.moveaxis(of_points, 1, 3))
            by_bend = sum(by_point[:, None, i] * along[:, i, :, None] for i in range(3))
            part = np.concatenate([part[:, :-2], by_bend, part[:, -2:]], axis=1)
        yield chunk, part, by_point


def blocks_by_batch(batches: PointBatches, state: CameraState, shapes: Array | None) -> Array:
    """Memory for the normal matrices of all batches."""
    whole = 12 + len(state.k) + (0 if shapes is None else N_SHAPES)
    return np.empty((len(batches.view), whole, whole))


def pose_columns(width: int, bends: bool) -> NDArray[np.intp]:
    """Columns of a view's own unknowns in normal matrices of this width: omega, tau, and bends if any."""
    last = np.arange(width - 1 - N_SHAPES, width - 1) if bends else np.arange(0)
    return np.concatenate([POSE_COLUMNS, last])

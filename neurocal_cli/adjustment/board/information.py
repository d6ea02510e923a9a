"""Normal equations of cameras, poses and target points together.

Each target point has an offset d from its given position, the same in all views. Around a state, the squared
error is a quadratic in the cameras' free parameters c, the poses q and the offsets d. Different poses are
coupled only through c and d, and different points only through c and q, so both parts are block diagonal.

The normal matrices of views have the columns of `reprojection`. With a bend in each view, they have three
more columns, for its coefficients, before that of the residual.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import Arrowhead
from neurocal_cli.adjustment.reprojection import POSE, POSE_COLUMNS, derivatives, free_columns, put_displaced
from neurocal_cli.adjustment.views import Views, batches_of, products
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.target import N_SHAPES


@frozen_dataclass(eq=False)
class Sight:
    """Observations of the target, at its current world coordinates, by one camera.

    `label` (N,) is the index of the target point of each row, in the order of `views`. With a bend in each
    view, `shapes` (n, 3, 3) has the offsets of each point for unit coefficients, and `bends` (V, 3) the
    current coefficients [world unit].
    """

    views: Views
    state: CameraState
    free: NDArray[np.bool_]
    free_poses: bool
    label: NDArray[np.intp]
    shapes: Array | None = None
    bends: Array | None = None

    @property
    def columns(self) -> NDArray[np.intp]:
        """Columns (f,) of the camera's free parameters in normal matrices."""
        return free_columns(self.free)

    @property
    def own_columns(self) -> NDArray[np.intp]:
        """Columns (p,) of a view's own unknowns in normal matrices: omega, tau, and bends if any."""
        more = 0 if self.shapes is None else N_SHAPES
        return np.concatenate([POSE_COLUMNS, 11 + len(self.state.k) + np.arange(more)])

    @cached_property
    def slots(self) -> NDArray[np.intp]:
        """(T, n) index of the target point in each slot of the batches; -1 for padding."""
        views, numbers = self.views, np.column_stack([self.label, self.label]).astype(float)
        laid = batches_of(views.local, numbers, None, views.index, views.n_views)
        found = np.rint(laid.pixels[:, 0]).astype(np.intp)
        if laid.whitening is not None:
            found[laid.whitening[:, 0] == 0] = -1
        return found

    def of_points(self, kept: NDArray[np.bool_]) -> Sight:
        """The observations of some points (N,), in the order of `views`."""
        which = np.unique(self.views.index[kept])
        views, state = self.views.of_points(kept), self.state.of_views(which)
        bends = None if self.bends is None else self.bends[which]
        return replace(self, views=views, state=state, label=self.label[kept], bends=bends)

    def memory(self) -> Array:
        """Memory for the normal matrices of all batches."""
        width = 6 + len(self.state.k) + len(self.own_columns)
        return np.empty((len(self.views.batches.view), width, width))

    def linearised(self, label: NDArray[np.intp]) -> Iterator[tuple[slice, Array, Array]]:
        """Chunks of batches, their rows of derivatives and residuals, and the derivatives by the points.

        `label` are the `slots`, or a single row of them that holds for all batches. With bends, the rows have
        the derivatives by each view's bend. They are overwritten in the next chunk.
        """
        batches, state, shapes = self.views.batches, self.state, self.shapes
        width = 12 + len(state.k)
        buffer = batches.memory(6 + len(state.k) + len(self.own_columns), state.square)
        for chunk in batches.chunks():
            view = batches.view[chunk]
            part = buffer[: len(view)]
            derivatives(batches, chunk, state, part[:, :width])
            # d Xc = R dM / S2, and the derivative by tau is that by the point in front of the camera.
            turn = np.swapaxes(state.R[view] / self.views.scale[view][:, None, None], 1, 2)
            by_tau = part[:, POSE.start + 3 : POSE.stop]
            by_point = (turn @ by_tau.reshape(len(view), 3, -1)).reshape(by_tau.shape)  # (T, 3, 2, n)
            if shapes is not None:
                of_points = shapes[label if len(label) == 1 else label[chunk]]  # (T, n, 3, 3) or (1, n, 3, 3)
                along = np.moveaxis(of_points, 1, 3)
                part[:, -2] = part[:, width - 1]
                put_displaced(by_point, np.ascontiguousarray(along), part[:, width - 1 : -2])
            yield chunk, part, by_point


@frozen_dataclass(eq=False)
class Information:
    """Blocks of the normal matrix and the right side: sums of products of derivatives and residuals [px].

    The shared unknowns of `cameras` are the free parameters of all cameras in sequence, each in its
    normalised units, and the own ones are the poses. With a bend in each view, a pose has p = 9 unknowns: its
    six, and the three coefficients of the view's whole bend. Otherwise p = 6. The points' unknowns are
    offsets in the world's axes and unit.
    """

    cameras: Arrowhead  # of f parameters and P poses, for given points
    point: Array  # (n, 3, 3)
    by_camera: Array  # (n, 3, f + 1) coupling of the points to the cameras, and their right sides
    pose_point: Array  # (P, p, n, 3)
    equations: float
    log_precision: float = 0.0  # sum of the logarithms of the prior precisions of the bends; see `held`

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return self.cameras.cost

    @property
    def spare(self) -> float:
        """Degrees of freedom: equations minus the unknowns of cameras and poses."""
        return self.equations - (len(self.cameras.shared) - 1) - 6 * len(self.pose_point)

    def held(self, precision: float) -> Information:
        """Add a Gaussian prior of this precision, in units of the noise precision, on the bends."""
        own, bends = self.cameras.own.copy(), np.arange(6, self.pose_point.shape[1])
        own[:, bends, bends] += precision
        logarithm = len(own) * len(bends) * np.log(precision)
        return replace(self, cameras=replace(self.cameras, own=own), log_precision=logarithm)

    def around_straight(self, bends: Array) -> Information:
        """The same quadratic in the whole bends (P, 3) instead of their changes."""
        by_pose = (self.cameras.own[:, :, 6:] @ bends[..., None])[..., 0]
        by_shared = np.einsum("pks,pk->s", self.cameras.cross[:, 6:], bends)
        by_camera = self.by_camera.copy()
        by_camera[..., -1] += np.einsum("pkni,pk->ni", self.pose_point[:, 6:], bends)
        more = float((bends * by_pose[:, 6:]).sum())
        return replace(self, cameras=self.cameras.around(by_pose, by_shared, more), by_camera=by_camera)

    def pose_by(self, offsets: Array) -> Array:
        """(P, p) contribution of offsets (n, 3) to the right side of the poses."""
        P, p = self.pose_point.shape[:2]
        return (self.pose_point.reshape(P * p, offsets.size) @ offsets.ravel()).reshape(P, p)

    def straight(self) -> Information:
        """The quadratic without bends."""
        arrow = Arrowhead(self.cameras.shared, self.cameras.own[:, :6, :6], self.cameras.cross[:, :6])
        return replace(self, cameras=arrow, pose_point=self.pose_point[:, :6], log_precision=0.0)

    def turned(self, axes: Array) -> Information:
        """Express each point's offset in its own axes, the columns of (n, 3, 3)."""
        transposed = np.swapaxes(axes, 1, 2)
        if (axes == axes[:1]).all():  # with a single plane one product suffices
            pose_point = (self.pose_point.reshape(-1, 3) @ axes[0]).reshape(self.pose_point.shape)
        else:
            pose_point = np.einsum("pqni,nij->pqnj", self.pose_point, axes)
        return replace(
            self,
            point=transposed @ self.point @ axes,
            by_camera=transposed @ self.by_camera,
            pose_point=pose_point,
        )

    def around_given(self, offsets: Array) -> Information:
        """The same quadratic in the whole offsets (n, 3) instead of their changes."""
        by_point = (self.point @ offsets[..., None])[..., 0]
        by_shared = np.einsum("nis,ni->s", self.by_camera, offsets)
        by_camera = self.by_camera.copy()
        by_camera[..., -1] += by_point
        cameras = self.cameras.around(self.pose_by(offsets), by_shared, float((offsets * by_point).sum()))
        return replace(self, cameras=cameras, by_camera=by_camera)


def information_of(sights: Sequence[Sight], n_points: int) -> Information:
    """Sum over the observations of all cameras; each camera has its own free parameters and poses."""
    widths = [int(sight.free.sum()) for sight in sights]
    poses = [sight.views.n_views if sight.free_poses else 0 for sight in sights]
    f, P, p = sum(widths), sum(poses), len(sights[0].own_columns)
    found = Information(
        Arrowhead(np.zeros((f + 1, f + 1)), np.zeros((P, p, p)), np.zeros((P, p, f + 1))),
        np.zeros((n_points, 3, 3)), np.zeros((n_points, 3, f + 1)), np.zeros((P, p, n_points, 3)),
        sum(sight.views.n_equations for sight in sights if sight.views.n_views),
    )  # fmt: skip
    ends = zip(np.cumsum(widths).tolist(), np.cumsum(poses).tolist(), strict=True)
    for sight, width, count, (end, last) in zip(sights, widths, poses, ends, strict=True):
        if sight.views.n_views:
            _add(found, sight, slice(end - width, end), slice(last - count, last))
    bends = [sight.bends for sight in sights if sight.bends is not None]
    return found.around_straight(np.concatenate(bends)) if bends else found


def information_by_fold(
    sights: Sequence[Sight], n_points: int, folds: Sequence[NDArray[np.intp]]
) -> list[Information]:
    """The same for each fold of the views; `folds` (V,) are those of each camera's views, from 0."""
    parts = []
    for k in range(1 + max(int(fold.max()) for fold in folds)):
        own = [
            sight.of_points((fold == k)[sight.views.index]) for sight, fold in zip(sights, folds, strict=True)
        ]
        parts.append(information_of(own, n_points))
    return parts


def steps_of_poses(info: Information, camera_step: Array, offsets: Array) -> Array:
    """(P, p) steps of the poses, and whole bends, given steps of the cameras (f,) and offsets (n, 3)."""
    cross = info.cameras.cross
    right = cross[:, :, -1] - cross[:, :, :-1] @ camera_step - info.pose_by(offsets)
    return np.asarray(np.linalg.solve(info.cameras.own, right[..., None])[..., 0])


def joined(parts: Sequence[Information]) -> Information:
    """Sum over parts of the views of the same cameras."""

    def total(name: str) -> Any:
        return sum(getattr(part, name) for part in parts)

    arrows = [part.cameras for part in parts]
    shared, own, cross = ([getattr(one, name) for one in arrows] for name in ("shared", "own", "cross"))
    return Information(
        Arrowhead(np.sum(shared, axis=0), np.concatenate(own), np.concatenate(cross)),
        total("point"), total("by_camera"), np.concatenate([part.pose_point for part in parts]),
        total("equations"), total("log_precision"),
    )  # fmt: skip


def _add(found: Information, sight: Sight, own: slice, poses: slice) -> None:
    """Add the observations of one camera."""
    views, columns, of_pose = sight.views, sight.columns, sight.own_columns
    # Filled where it stays, because allocating these blocks took half of the time of all with 1000 views.
    cross = found.pose_point[poses]
    if not sight.free_poses:
        cross = np.zeros((views.n_views, len(of_pose), len(found.point), 3))
    normal, summed = _terms(sight, cross)
    px2 = views.pixel_scale**2
    kept, place = np.append(columns, normal.shape[1] - 1), np.append(np.arange(own.start, own.stop), -1)
    found.cameras.shared[place[:, None], place] += px2 * normal.sum(axis=0)[kept[:, None], kept]
    found.point[...] += px2 * summed[..., :3]
    found.by_camera[..., own] += px2 * summed[..., 3:-1]  # slices are faster than indices
    found.by_camera[..., -1] += px2 * summed[..., -1]
    if sight.free_poses:
        found.cameras.own[poses] = px2 * normal[:, of_pose[:, None], of_pose]
        found.cameras.cross[poses, :, own] = px2 * normal[:, of_pose[:, None], columns]
        found.cameras.cross[poses, :, -1] = px2 * normal[:, of_pose, -1]
        cross *= px2


def _terms(sight: Sight, cross: Array) -> tuple[Array, Array]:
    """Normal matrices (V, w, w) of one camera's views, and sums over each point (n, 3, f + 4).

    The sums are products of the derivatives by the points with these, those by the camera's free parameters
    and the residuals, all normalised. `cross` (V, p, n, 3) are zeros that become those with the views' own
    unknowns.
    """
    batches, label, n_points = sight.views.batches, sight.slots, cross.shape[2]
    of_pose, by_batch = sight.own_columns, sight.memory()
    kept = np.append(sight.columns, by_batch.shape[1] - 1)
    ordered = np.sort(label, axis=1)
    twice = (ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)
    once = len(label) == len(cross) and not twice.any()  # each view is one batch, in which no point is twice
    alike = once and label[0, 0] >= 0 and bool((label == label[0]).all())
    summed = np.zeros((n_points, 3, len(kept) + 3))
    for chunk, part, by_point in sight.linearised(label[:1] if alike else label):
        view, seen = batches.view[chunk], label[chunk]
        products(part, by_batch[chunk])
        rows = np.concatenate([by_point, part[:, kept]], axis=1)
        crossed = np.swapaxes(_of_each(part[:, of_pose], by_point), 2, 3)  # (T, p, n, 3)
        if alike:
            own, rows = by_point.transpose(3, 1, 0, 2), rows.transpose(3, 0, 2, 1)
            n = len(own)
            summed[seen[0]] += own.reshape(n, 3, -1) @ rows.reshape(n, -1, len(kept) + 3)
            cross[view[0] : view[-1] + 1, :, seen[0]] = crossed
            continue
        real = seen >= 0
        every, flat = np.moveaxis(_of_each(by_point, rows), 3, 1)[real], seen[real]
        summed += _summed_by(flat, every.reshape(len(flat), -1), n_points).reshape(summed.shape)
        places = np.broadcast_to(view[:, None], real.shape)[real], flat
        each = np.swapaxes(crossed, 1, 2)[real]
        if once:
            np.swapaxes(cross, 1, 2)[places] = each
        else:
            np.add.at(np.swapaxes(cross, 1, 2), places, each)
    return batches.sum_by_view(by_batch), summed


def _of_each(a: Array, b: Array) -> Array:
    """(T, i, j, n) products of rows (T, i, 2, n) and (T, j, 2, n) of each point, summed over u and v."""
    product = a[:, :, None, 0] * b[:, None, :, 0]
    product += a[:, :, None, 1] * b[:, None, :, 1]
    return np.asarray(product)


def without_points(sight: Sight) -> Array:
    """(V, w, w) normal matrices of one camera's views [px], for given target points."""
    batches, by_batch = sight.views.batches, sight.memory()
    for chunk, part, _ in sight.linearised(sight.slots):
        products(part, by_batch[chunk])
    return sight.views.pixel_scale**2 * batches.sum_by_view(by_batch)


def of_views(sight: Sight, normal: Array, which: NDArray[np.bool_]) -> Information:
    """Information of some views (V,) of one camera, from `without_points`, with fixed target points."""
    of_pose, P = sight.own_columns, which.sum() * sight.free_poses
    arrow = Arrowhead.of(normal[which], sight.columns, of_pose)
    found = Information(
        replace(arrow, own=arrow.own[:P], cross=arrow.cross[:P]),
        np.zeros((0, 3, 3)), np.zeros((0, 3, len(arrow.shared))), np.zeros((P, len(of_pose), 0, 3)),
        float(sight.views.equations[which].sum()),
    )  # fmt: skip
    return found if sight.bends is None else found.around_straight(sight.bends[which])


def _summed_by(label: NDArray[np.intp], rows: Array, n: int) -> Array:
    """(n, m) sums of the rows (N, m) with the same label."""
    order = np.argsort(label, kind="stable")
    ordered = label[order]
    first = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    out = np.zeros((n, rows.shape[1]))
    out[ordered[first]] = np.add.reduceat(rows[order], first, axis=0)
    return out

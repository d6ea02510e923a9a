"""A camera at its minimum, linearised, with the effects by which rival causes would change its pixels.

An effect is some columns of derivatives by what is usually not estimated, such as bends of the board or the
movement of the camera while the rows are read. With each view's pose eliminated, a small matrix of each view
tells all that the residuals say about the camera and the effects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.cross_validation import RIDGE, Minimum
from neurocal_cli.adjustment.normal_equations import eliminate
from neurocal_cli.adjustment.reprojection import POSE, POSE_COLUMNS, camera_columns, derivatives
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.directions import DECENTRED
from neurocal_cli.camera.distortion import POLYNOMIAL_MODELS
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState

_RICHER = {**dict.fromkeys(POLYNOMIAL_MODELS, "plumb_bob"), "plumb_bob": "rational", **DECENTRED}
_FLAT = 0.02  # largest thickness over size of a board that counts as flat
_ACROSS = 11  # points of a grid on the board
_ALONG = 1e-6  # by which a normal that is an axis of the world may differ from it


@frozen_dataclass(eq=False)
class Board:
    """The axes of the target that all views show."""

    centre: Array
    axes: Array  # (3, 3) columns: along a flat board, across it, its normal; else those of the world
    size: float  # farthest point along the first one, or along any [world unit]
    aspect: float  # across over along; nan if it is not flat

    @classmethod
    def of(cls, views: Views) -> Board:
        """Axes of the points of all views."""
        world = views.world
        centre = world.mean(axis=0)
        solid = cls(centre, np.eye(3), float(np.abs(world - centre).max()), np.nan)
        if not views.nearly_flat.all():
            return solid
        axes = np.linalg.eigh((world - centre).T @ (world - centre))[1][:, ::-1]
        if np.abs(axes[:, 2]).max() > 1.0 - _ALONG:  # prints are stretched along the axes that they have
            longer, shorter, normal = np.argsort(np.abs(world - centre).max(axis=0))[::-1]
            axes = np.eye(3)[:, [longer, shorter, normal]]
        size = np.abs((world - centre) @ axes).max(axis=0)
        return cls(centre, axes, size[0], size[1] / size[0]) if size[2] <= _FLAT * size[0] else solid

    @property
    def flat(self) -> bool:
        """Whether it is flat."""
        return not np.isnan(self.aspect)

    def bend(self, height: Callable[[Array, Array], Array]) -> float:
        """Height between the highest and the lowest point [world unit], of heights over the half length."""
        ends = np.linspace(-1, 1, _ACROSS)
        x, y = np.repeat(ends, _ACROSS), self.aspect * np.tile(ends, _ACROSS)
        plane, z = np.column_stack([np.ones_like(x), x, y]), height(x, y)
        return float(np.ptp(z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0])) * self.size


@frozen_dataclass(eq=False)
class Seen:
    """T batches of n points each, for the functions that return an effect's columns (T, m, 2, n)."""

    by_entries: Array  # (T, 5, 2, n) derivatives of the pixels by the entries of A
    pixels: Array  # (T, 2, n) where the camera sees the points, from the middle of the image; over S1
    observed: Array  # (T, 2, n) where they were observed [px]
    from_centre: Array  # (T, 2, n) the same places as `pixels`, from the image centre
    focal: Array  # (2,) focal lengths along u and v, over S1
    by_pose: Array  # (T, 6, 2, n) derivatives by the poses of the views
    origin: Array  # (T, 3) the middle of the target from the camera, over its size in this view
    size: Array  # (T,) this, over that of all views
    half: float  # the half length of the target, over the same
    # Derivatives (T, 3, 2, n) along the axes of the target, over its half length: along a board, across it
    # and along its normal, else along those of the world; the places (3, T, n), over the same; and the
    # directions (T, 3, n) to the camera along these axes.
    by_target: Array
    at: Array
    to_camera: Array
    flat: bool  # whether all views show one flat board


Effect = Callable[[Seen], Array | None]


@frozen_dataclass(eq=False)
class Linearised:
    """One camera, linearised at its minimum, with the poses of its views eliminated.

    All is normalised. The columns are the entries of A, the coefficients of the lens, the effects and, as the
    last one, the residual.
    """

    views: Views
    state: CameraState  # with the coefficients that the distortion model lacks, as zeros
    effects: tuple[Effect, ...]
    middle: Array  # (2,) of the image
    R: Array  # (V, c + 1, c + 1)
    before: Array  # (V, c) diagonal of the same before the poses were eliminated
    solved: Array  # (V, 6, c + 1) response of the poses to the columns, and their own step
    # Of each effect, and of the coefficients of the "lens" that are not estimated.
    columns: Mapping[Effect | str, NDArray[np.intp]]
    free: NDArray[np.intp]  # columns that are estimated
    given: NDArray[np.intp]  # those of the entries of A that are given
    spare: float  # equations beyond the unknowns
    board: Board
    free_poses: bool  # whether the poses are estimated

    @property
    def alphas_free(self) -> bool:
        """Whether alpha_u and alpha_v are estimated."""
        return bool(np.isin((0,) if self.state.square else (0, 2), self.free).all())

    @property
    def width(self) -> int:
        """Number of columns c without the residual."""
        return self.R.shape[1] - 1

    @property
    def cost(self) -> float:
        """Squared error."""
        return float(self.R[:, -1, -1].sum())

    def residuals(self, step: Array) -> Array:
        """(N, 2) residuals in the order of the points, after steps (V, c) of all columns."""
        poses = self.solved[..., -1] - (self.solved[..., :-1] @ step[..., None])[..., 0]
        batches, camera = self.views.batches, 5 + len(self.state.k)
        whole = np.concatenate([step[:, :5], poses, step[:, 5:camera], step[:, camera:]], axis=1)
        left = np.empty((len(batches.view), 2, batches.local.shape[2]))
        for chunk, J, _ in _derivatives(self.views, self.state, self.middle, self.board, self.effects):
            left[chunk] = J[:, -1] - np.einsum("tc,tcin->tin", whole[batches.view[chunk]], J[:, :-1])
        errors = np.swapaxes(left, 1, 2).reshape(-1, 2)  # with padding
        return errors[np.repeat(batches.first * left.shape[2], self.views.counts) + self.views.rank]


def linearised(
    m: Minimum, effects: tuple[Effect, ...], image_size: tuple[int, int] | None = None
) -> Linearised:
    """Add the columns of effects to a camera at its minimum."""
    views, free, state = m.views, m.free, m.state.with_model(_RICHER.get(m.state.model, m.state.model))
    K, board = len(state.k), Board.of(views)
    middle = np.zeros(2)
    if image_size is not None:
        middle = ((np.array(image_size) - 1) / 2 - views.pixel_centre) / views.pixel_scale
    products = []  # of one chunk after the other, as the derivatives of all take far more memory
    for _, J, found in _derivatives(views, state, middle, board, effects):
        flat, widths = J.reshape(*J.shape[:2], -1), found
        products.append(flat @ np.swapaxes(flat, 1, 2))
    N = views.batches.sum_by_view(np.concatenate(products))
    kept = np.concatenate([camera_columns(K), np.arange(11 + K, N.shape[1])])
    if m.free_poses:
        R, solved = eliminate(N, kept, POSE_COLUMNS, RIDGE)
    else:
        R, solved = N[:, kept[:, None], kept], np.zeros((len(N), 6, len(kept)))
    columns: dict[Effect | str, NDArray[np.intp]] = {"lens": np.arange(len(free), 5 + K)}
    at = 5 + K
    for effect, width in widths.items():
        columns[effect] = np.arange(at, at + width)
        at += width
    spare = views.n_equations - int(free.sum()) - (6 * views.n_views if m.free_poses else 0)
    return Linearised(
        views, state, effects, middle, R, N[:, kept[:-1], kept[:-1]], solved, columns,
        np.flatnonzero(free), np.flatnonzero(~free[:5]), max(spare, 1.0), board, m.free_poses,
    )  # fmt: skip


def _derivatives(
    views: Views, state: CameraState, middle: Array, board: Board, effects: tuple[Effect, ...]
) -> Iterator[tuple[slice, Array, dict[Effect, int]]]:
    """Derivatives (T, c + 7, 2, n) of chunks of the batches, and the widths of the effects among them."""
    batches, K = views.batches, len(state.k)
    for chunk in batches.chunks():
        view, observed = batches.view[chunk], batches.pixels[chunk]
        J = np.zeros((len(view), 12 + K, 2, observed.shape[2]))
        derivatives(batches, chunk, state, J)
        # An effect at the observed places would contain the noise that it has to explain.
        off = J[:, -1].copy()
        if batches.whitening is not None:
            w = batches.whitening[chunk].swapaxes(0, 1)
            with np.errstate(divide="ignore", invalid="ignore"):
                off[:, 1] /= w[2]
                off[:, 0] = (off[:, 0] - w[1] * off[:, 1]) / w[0]
            off = np.nan_to_num(off, nan=0.0, posinf=0.0, neginf=0.0)  # of padding
        px = views.pixel_scale * observed + views.pixel_centre[:, None]
        by_pose, scale, local = J[:, POSE], views.scale[view][:, None, None], batches.local[chunk]
        back, tau = np.swapaxes(state.R[view], 1, 2), state.t[view]
        world = local * scale + views.centre[view][:, :, None]
        at = np.moveaxis(board.axes.T @ (world - board.centre[:, None]) / board.size, 1, 0)
        by_local = (back @ by_pose[:, 3:].reshape(len(view), 3, -1)).reshape(by_pose[:, 3:].shape)
        by_target = np.einsum("ia,tipn->tapn", board.axes, by_local * (board.size / scale[..., None]))
        to_camera = np.einsum("ia,tin->tan", board.axes, -back @ tau[:, :, None] - local)
        from_centre, focal = observed - off - state.entries[0, 3:, None], state.entries[0, [0, 2]]
        seen = Seen(
            J[:, :5], observed - off - middle[:, None], px, from_centre, focal,
            by_pose, tau, views.scale[view] / views.scale.mean(), board.size / views.scale.mean(),
            by_target, at, to_camera, board.flat,
        )  # fmt: skip
        found = {effect: part for effect in effects if (part := effect(seen)) is not None}
        widths = {effect: part.shape[1] for effect, part in found.items()}
        yield chunk, np.concatenate([J[:, :-1], *found.values(), J[:, -1:]], axis=1), widths

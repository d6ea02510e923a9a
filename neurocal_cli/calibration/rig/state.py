"""The unknowns of a rig: cameras, their poses, the poses of the frames, and delays on the target's path."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.camera.state import CameraState


@frozen_dataclass(eq=False)
class Motion:
    """The path of the target around each frame, and when the views were taken."""

    # (V, k, 6) turn and shift of the target, normalised: the coefficients of the powers of time from 1 to k.
    path: Array
    lag: tuple[Array, ...]  # of each camera, (V_c,) stated time of the view less that of its frame
    stated: bool = False  # whether the times are stated

    def of(self, frames: NDArray[np.intp]) -> Motion:
        """With the paths of other frames, (V,) of the present ones."""
        return replace(self, path=self.path[frames])

    def at(self, elapsed: Array, frames: NDArray[np.intp]) -> tuple[Array, Array]:
        """Turn and shift (n, 6) after some time (n,), and their derivatives by the time."""
        powers = np.arange(1, self.path.shape[1] + 1)
        path = self.path[frames]
        moved = elapsed[:, None] ** powers
        speed = powers * elapsed[:, None] ** (powers - 1)
        return np.einsum("np,npi->ni", moved, path), np.einsum("np,npi->ni", speed, path)


@frozen_dataclass(eq=False)
class Columns:
    """Columns of the unknowns in the normal matrix: A's entries and coefficients, and steps w, tau."""

    cameras: tuple[NDArray[np.intp], ...]  # (5 + K,) of each
    rigs: tuple[NDArray[np.intp], ...]  # (6,) of each camera but the first, for which it is empty
    delays: tuple[NDArray[np.intp], ...]  # (1,) likewise; all empty without a motion

    @property
    def n_shared(self) -> int:
        """Number of unknowns that all views share."""
        return sum(map(len, (*self.cameras, *self.rigs, *self.delays)))


@frozen_dataclass(eq=False)
class RigState:
    """The cameras, the rig X_c = R_c X_first + t_c, and the poses Xc / scale = R_k local + t_k."""

    cameras: tuple[CameraState, ...]  # only their entries and distortion are used
    R: Array  # (C, 3, 3), the first is the identity
    t: Array  # (C, 3) in units of `RigProblem.unit`, the first is 0
    view_R: Array  # (V, 3, 3) of each frame, in the first camera or, for frames of one camera alone, in that
    view_t: Array  # (V, 3)
    delay: Array  # (C,) of each camera's images [unit of time], the first is 0
    timed: bool  # whether the delays are unknowns

    @cached_property
    def columns(self) -> Columns:
        """Columns of the unknowns for the distortion models of the cameras."""
        C = len(self.cameras)
        widths = [5 + len(camera.k) for camera in self.cameras]
        widths += [0, *[6] * (C - 1), 0, *[int(self.timed)] * (C - 1)]
        places = [np.arange(end - width, end) for width, end in zip(widths, accumulate(widths), strict=True)]
        return Columns(tuple(places[:C]), tuple(places[C : 2 * C]), tuple(places[2 * C :]))

    def moved(self, shared: Array, own: Array) -> RigState:
        """The state after a step: shared (columns.n_shared,), own (V, 6)."""
        columns = self.columns
        cameras = tuple(
            replace(
                camera.with_entries(camera.entries + shared[None, place[:5]]), k=camera.k + shared[place[5:]]
            )
            for camera, place in zip(self.cameras, columns.cameras, strict=True)
        )
        steps = np.zeros((len(cameras), 6))
        steps[1:] = shared[np.concatenate(columns.rigs)].reshape(-1, 6)
        delay = self.delay.copy()
        if self.timed:
            delay[1:] += shared[np.concatenate(columns.delays)]
        return RigState(
            cameras,
            rotation_step(steps[:, :3]) @ self.R,
            self.t + steps[:, 3:],
            rotation_step(own[:, :3]) @ self.view_R,
            self.view_t + own[:, 3:],
            delay,
            self.timed,
        )

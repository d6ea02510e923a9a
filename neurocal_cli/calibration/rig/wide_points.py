"""Triangulation with a wide lens, whose rays may be 90 degrees and more from the axis.

As `two_view_points`, but the point is B (x, y, 1) / w, where the third column of B is the ray of its left
pixel: x and y stay small wherever the ray points, and w is one over the distance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.rig.two_view_points import (
    MAX_STEPS,
    RISE,
    ROUNDING,
    SMALL_STEP,
    inverse_entries,
    nearest_solution,
)
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.geometry import Array, cross_matrix

_HALVINGS = 10


class WidePointBatch:
    """Some thousand points, from the same as a `PointBatch`."""

    def __init__(
        self,
        cameras: tuple[Camera, Camera],
        rig: Array,
        left: Array,
        right: Array,
        whitening: tuple[Array, Array] | None,
    ) -> None:
        self.cameras, self.pixels = cameras, (left.T, right.T)
        self.P = np.broadcast_to(np.moveaxis(rig, -1, 0), (left.shape[1], 3, 4))
        self.R, self.t = self.P[:, :, :3], self.P[:, :, 3]
        self.whitening = None if whitening is None else tuple(_upper(factors) for factors in whitening)
        self.left = cameras[0].unproject(self.pixels[0])
        self.right = cameras[1].unproject(self.pixels[1])

    def optimal(self) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Least-squares points (n, 3), covariances (n, 6), epipolar errors, and which points are behind."""
        lost = ~np.isfinite(self.left[:, 0] + self.right[:, 0])
        basis = _basis(np.where(lost[:, None], [0.0, 0.0, 1.0], self.left))
        w = self._nearest_w()
        lost |= ~np.isfinite(w)
        q = np.column_stack([np.zeros((len(w), 2)), np.where(lost, 1.0, w)])
        J, r, seen = self._linearised(basis, q)
        cost = (r * r).sum(axis=1)
        for _ in range(MAX_STEPS):
            step = _solved(J, r)
            if not np.linalg.norm((J @ step[..., None])[..., 0], axis=1).max(initial=0.0) > SMALL_STEP:
                break
            for _ in range(_HALVINGS):
                trial = self._linearised(basis, q + step)
                new = (trial[1] ** 2).sum(axis=1)
                worse = ~(new <= cost * RISE + ROUNDING)
                if not worse.any():
                    break
                step[worse] *= 0.5
            step[worse] = 0.0
            q = q + step
            J, r, seen = self._linearised(basis, q)
            cost = (r * r).sum(axis=1)
        w = q[:, 2:]
        points = self._directions(basis, q) / w
        # dP = (B (dx, dy, 0) - P dw) / w.
        by_q = np.concatenate([basis[:, :, :2], -points[:, :, None]], axis=2) / w[:, :, None]
        spread = by_q @ _inverse(np.swapaxes(J, 1, 2) @ J) @ np.swapaxes(by_q, 1, 2)
        a, b = np.triu_indices(3)
        covariance, epipolar = spread[:, a, b], np.sqrt(cost)
        points[lost], covariance[lost], epipolar[lost] = np.nan, np.nan, np.nan
        return points, covariance, epipolar, lost | ~(w[:, 0] > 0) | ~seen

    def _nearest_w(self) -> Array:
        """One over the distance along the left ray whose image is nearest to the right ray."""
        across = np.cross(self.right, (self.R @ self.left[..., None])[..., 0])
        along = np.cross(self.right, self.t)
        return np.asarray(-(across * along).sum(axis=1) / (along * along).sum(axis=1))

    @staticmethod
    def _directions(basis: Array, q: Array) -> Array:
        """B (x, y, 1)."""
        return np.asarray((basis @ np.column_stack([q[:, :2], np.ones(len(q))])[..., None])[..., 0])

    def _linearised(self, basis: Array, q: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Derivatives (n, 4, 3) of both pixels by x, y, w; what is missing (n, 4); and which are seen."""
        m = self._directions(basis, q)
        h = (self.R @ m[..., None])[..., 0] + q[:, 2:] * self.t
        by_left, left, seen_left = self._seen(0, m)
        by_right, right, seen_right = self._seen(1, h)
        turned = self.R @ basis[:, :, :2]
        J = np.concatenate(
            [
                np.concatenate([by_left @ basis[:, :, :2], np.zeros((len(q), 2, 1))], axis=2),
                by_right @ np.concatenate([turned, self.t[:, :, None]], axis=2),
            ],
            axis=1,
        )
        return J, np.concatenate([left, right], axis=1), seen_left & seen_right

    def _seen(self, side: int, points: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Derivatives of pixels by points, what is missing to the observed ones, and what is seen."""
        camera = self.cameras[side]
        pixels, seen = camera.project(points)
        by_point, missing = camera.project_jacobian(points)[1], self.pixels[side] - pixels
        if self.whitening is not None:
            factors = self.whitening[side]
            by_point, missing = factors @ by_point, (factors @ missing[..., None])[..., 0]
        return by_point, missing, seen

    def linear(self) -> Array:
        """(n, 3) smallest singular vectors of the equations that each ray is parallel to its point."""
        rows = [cross_matrix(self.left) @ np.eye(3, 4), cross_matrix(self.right) @ self.P]
        return nearest_solution(np.concatenate(rows, axis=1))

    def midpoint(self) -> Array:
        """(n, 3) midpoints of the shortest segments between the rays."""
        back = np.swapaxes(self.R, 1, 2)
        left, right = self.left, (back @ self.right[..., None])[..., 0]
        centre = -(back @ self.t[..., None])[..., 0]
        cosine = (left * right).sum(axis=1)
        lc, rc = (left * centre).sum(axis=1), (right * centre).sum(axis=1)
        det = 1.0 - cosine * cosine
        along_left, along_right = (lc - cosine * rc) / det, (cosine * lc - rc) / det
        return np.asarray(0.5 * (along_left[:, None] * left + centre + along_right[:, None] * right))

    def compare(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Distances of the points' images from the pixels [px], and which points are behind."""
        in_right = (self.R @ points[..., None])[..., 0] + self.t
        _, left, seen_left = self._seen(0, points)
        _, right, seen_right = self._seen(1, in_right)
        epipolar = np.sqrt((left * left).sum(axis=1) + (right * right).sum(axis=1))
        # A pixel's ray has one side only.
        before = ((points * self.left).sum(axis=1) > 0) & ((in_right * self.right).sum(axis=1) > 0)
        return epipolar, ~(seen_left & seen_right & before & np.isfinite(epipolar))


def _basis(rays: Array) -> Array:
    """(n, 3, 3) right-handed unit vectors, the third of which is the ray."""
    # The coordinate axis that is most across the ray.
    axis = np.eye(3)[np.argmin(np.abs(rays), axis=1)]
    first = np.cross(axis, rays)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(rays, first), rays], axis=2)


def _upper(factors: Array) -> Array:
    """(n, 2, 2) from the entries (0, 0), (0, 1), (1, 1) of (3, n)."""
    out = np.zeros((factors.shape[1], 2, 2))
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 1] = factors
    return out


def _solved(J: Array, r: Array) -> Array:
    """Gauss-Newton steps (n, 3); none where the equations are singular."""
    Jt = np.swapaxes(J, 1, 2)
    step = (_inverse(Jt @ J) @ (Jt @ r[..., None]))[..., 0]
    return np.where(np.isfinite(step).all(axis=1, keepdims=True), step, 0.0)


def _inverse(N: Array) -> Array:
    """Inverses (n, 3, 3) of symmetric matrices; not finite where they are singular."""
    upper = [N[:, j, k] for j in range(3) for k in range(j, 3)]
    return np.stack(inverse_entries(upper), axis=1)[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]

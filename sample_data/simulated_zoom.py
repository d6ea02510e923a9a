"""A zoom lens to try things on, by a stated optical law, and what it would see.

With z and f the zoom and focus encoders as shares of their range:

    F = F_w F_t / (F_t - (F_t - F_w) z)       two thin groups, the zoom encoder moves one of them
    v = F / (1 - F f / d)                     thin-lens formula, focused at the distance d / f
    alpha_u = v / pitch,  alpha_v = aspect alpha_u
    (u0, v0) = centre + wander (cos, sin)(2 z + f)
    t_z = distance + pupil (1 - z)^2 - (v - F)     the entrance pupil moves with zoom and extension
    k1 = k_w + (k_t - k_w) z
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from neurocal_cli.calibration.zoom.settings import LensPoints
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose, entries_of
from neurocal_cli.camera.projection import image_points
from neurocal_cli.files.points_csv import format_points
from neurocal_cli.files.writing import write_whole
from neurocal_cli.observations.points import Correspondences


@dataclass(frozen=True, eq=False)
class SimulatedZoom:
    """A camera with a zoom lens; lengths in mm unless named otherwise.

    Parameters
    ----------
    zoom_range, focus_range : (float, float)
        Of the encoders.
    wide, tele : float
        F_w and F_t.
    nearest : float
        d, the distance at the end of the focus range.
    pitch, aspect : float
    image_size : (int, int) [px]
    wander : float [px]
    distance, pupil : float
    k_wide, k_tele : float
    pose : Pose
        Its t_z is replaced by the law's.
    theta : float [rad]
    """

    zoom_range: tuple[float, float] = (0.0, 3000.0)
    focus_range: tuple[float, float] = (0.0, 900.0)
    wide: float = 9.0
    tele: float = 36.0
    nearest: float = 400.0
    pitch: float = 0.012
    aspect: float = 0.998
    image_size: tuple[int, int] = (640, 480)
    wander: float = 6.0
    distance: float = 1500.0
    pupil: float = 60.0
    k_wide: float = 0.0
    k_tele: float = 0.0
    pose: Pose = field(
        default_factory=lambda: Pose.from_euler(0.15, -0.22, 0.05, np.array([12.0, -8.0, 0.0]))
    )
    theta: float = 1.5706

    def parameters(self, settings: Array) -> dict[str, Array]:
        """Local parameters at settings (n, 2) of zoom and focus, by name, and k1."""
        low = np.array([self.zoom_range[0], self.focus_range[0]])
        high = np.array([self.zoom_range[1], self.focus_range[1]])
        z, f = ((np.asarray(settings, dtype=float) - low) / (high - low)).T
        focal = self.wide * self.tele / (self.tele - (self.tele - self.wide) * z)
        extended = focal / (1 - focal * f / self.nearest)
        angle = 2 * z + f
        return {
            "alpha_u": extended / self.pitch,
            "alpha_v": self.aspect * extended / self.pitch,
            "u0": (self.image_size[0] - 1) / 2 + self.wander * np.cos(angle),
            "v0": (self.image_size[1] - 1) / 2 + self.wander * np.sin(angle),
            "t_z": self.distance + self.pupil * (1 - z) ** 2 - (extended - focal),
            "k1": self.k_wide + (self.k_tele - self.k_wide) * z,
        }

    def points(self, settings: Array, side: int, sigma: float, rng: np.random.Generator) -> LensPoints:
        """See two boards of side x side points at settings (n, 2), with noise of sigma px in u and v."""
        return see(
            self.parameters(settings), settings, self.pose, self.theta, self.image_size, side, sigma, rng
        )


def see(
    parameters: dict[str, Array],
    settings: Array,
    pose: Pose,
    theta: float,
    image_size: tuple[int, int],
    side: int,
    sigma: float,
    rng: np.random.Generator,
) -> LensPoints:
    """Points of two oblique boards, one behind the other, that fill four fifths of the image everywhere.

    At each setting the boards' points are as far apart as the image is wide there, as on a stand
    with boards of several sizes.
    """
    n, per = len(settings), 2 * side * side
    p = {name: np.asarray(values, dtype=float) for name, values in parameters.items()}
    unit = np.stack(np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side)), axis=-1).reshape(-1, 2)
    half = 0.4 * np.array(image_size)
    near, far = (p["t_z"] * share for share in (0.9, 1.1))
    local = np.empty((n, per, 3))
    for k, depth in enumerate((near, far)):
        part = local[:, k * side * side : (k + 1) * side * side]
        part[:, :, :2] = unit * (half / p["alpha_u"][:, None] * depth[:, None])[:, None]
        part[:, :, 2] = (depth - p["t_z"])[:, None] + 0.3 * part[:, :, 0]
    world = np.round(local @ pose.R, 4)
    camera = world @ pose.R.T + np.column_stack([np.tile(pose.t[:2], (n, 1)), p["t_z"]])[:, None]
    x, y = camera[..., 0] / camera[..., 2], camera[..., 1] / camera[..., 2]
    alpha_u, alpha_v, u0, v0, k1 = (p[name][:, None] for name in ("alpha_u", "alpha_v", "u0", "v0", "k1"))
    u, v = image_points(entries_of(alpha_u, alpha_v, u0, v0, theta), "k1", [k1], x, y)
    pixels = np.stack([u, v], axis=-1) + sigma * rng.normal(size=(n, per, 2))
    names = np.repeat([f"setting{k + 1:02d}" for k in range(n)], per)
    points = Correspondences(world.reshape(-1, 3), np.round(pixels, 5).reshape(-1, 2), names, image_size)
    columns = np.repeat(np.asarray(settings, dtype=float), per, axis=0).T
    return LensPoints.grouped(points, dict(zip(("zoom", "focus"), columns, strict=False)))


def write_lens_points(lens: LensPoints, path: str | Path) -> None:
    """Write points with the columns of their settings; they read back to the last bit."""
    lines = format_points(lens.points).split("\n")
    first = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    settings = [",".join(map(repr, row)) for row in lens.settings.tolist()]
    lines[first] = ",".join([*lens.controls, lines[first]])
    for k, s in enumerate(lens.point_setting.tolist(), start=first + 1):
        lines[k] = f"{settings[s]},{lines[k]}"
    write_whole(path, "\n".join(lines))

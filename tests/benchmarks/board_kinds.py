"""Boards of four kinds in ten conditions: errors over the Cramer-Rao bound and the covariance, beside others.

Run with ``PYTHONPATH=tests python tests/benchmarks/board_kinds.py FIRST NUMBER [CONDITION/KIND ...]``: each
cell has NUMBER pictures, from the seed FIRST on. `aprilgrid` and `lensboy` of PyPI are compared if they are
installed.

A cell tells the rms error of the vertices over the bound, their squared error over the covariance, both with
the standard deviation by leaving out one picture after the other, the share of the vertices that are found,
and the error and share of other programs.
"""

import conftest  # noqa: F401 - one thread, before NumPy loads its BLAS

# isort: split
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass, field, replace
from io import StringIO

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from support.marked import marked_scene, plane_of, taken
from support.picture_bound import edge_bound, vertex_bound
from support.pictures import Illumination, Rendered, Scene

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.detection.detect import detect_points
from neurocal_cli.errors import NeurocalError
from neurocal_cli.observations.board_kinds import CirclePlane

# Board, distance of its vertices [px], and the same if they are small.
KINDS = {
    "chessboard": ("chessboard:9x6:28", 36.0, 14.0),
    "charuco": ("charuco:10x7:28:21:DICT_5X5_100", 36.0, 14.0),
    "aprilgrid": ("aprilgrid:6x4:40:0.3", 52.0, 30.0),
    "circles": ("asymmetric_circles:4x11:20:16", 28.0, 14.0),
}
CONDITIONS: dict[str, dict[str, object]] = {
    "base": {},
    "noise": {"noise": 8.0},
    "blur": {"psf": 2.0},
    "tilt": {"tilt": 60.0},
    "lens": {"k1": -0.3},
    "light": {"illumination": Illumination(0.6, (0.8, 0.5))},
    "small": {},
    "half": {},
    "sharpened": {},
    "fisheye": {},
}
SHARPENING, RADIUS = 2.0, 1.0  # k and r [px] of I + k (I - G * I)
BESIDE = 0.6  # squares from the cover, within which vertices are not compared
NEAR = 6.0  # px, within which a point of another program is a vertex
ANGLES = np.linspace(0, 2 * np.pi, 181)
_BLACK, _WHITE = 30.0, 226.0  # DN


def scene_of(kind: str, condition: str, seed: int) -> Scene:
    """A board in a condition; before the fisheye, it is near and 80 degrees wide."""
    form, square, small = KINDS[kind]
    wide = condition == "fisheye"
    square, size = (
        (1.3 * square, (960, 720)) if wide else (small if condition == "small" else square, (640, 480))
    )
    scene = marked_scene(plane_of(form), seed, square=square, size=size, **CONDITIONS[condition])  # type: ignore[arg-type]
    if not wide:
        return scene
    old, focal = scene.camera.intrinsics, size[0] / np.pi
    lens = Camera(
        Intrinsics(focal, 1.003 * focal, old.u0, old.v0), Distortion("fisheye", (0.0, 0.0, 0.0, 0.0)), size
    )
    nearer = scene.pose.t * [1.0, 1.0, focal / old.alpha_u]
    return replace(scene, camera=lens, pose=replace(scene.pose, t=nearer))


def picture_of(scene: Scene, condition: str, seed: int) -> tuple[Rendered, float]:
    """The picture, and the column from which on its board is hidden."""
    picture = taken(scene, seed, 8)
    if condition == "sharpened":
        pale = 128 + 0.5 * (picture.image - 128.0)
        pale += SHARPENING * (pale - gaussian_filter(pale, RADIUS))
        return replace(picture, image=np.clip(np.rint(pale), 0, 255).astype(np.uint8)), np.inf
    if condition != "half":
        return picture, np.inf
    middle = float(np.nanmean(picture.truth.planes[0].vertices[..., 0]))
    image = picture.image.copy()
    image[:, int(middle) :] = 128
    return replace(picture, image=image), middle


def bounds(scene: Scene, picture: Rendered) -> Array:
    """Variance (rows, cols) [px^2] of vertices, the mean of both axes, that no unbiased estimate is below.

    The edges count up to half of the way to the next vertex, with known directions, and no ink of markers.
    """
    (truth,) = picture.truth.planes
    noise = np.sqrt(scene.sensor.read_noise**2 + 1 / 12)
    width, height = scene.size
    place = truth.vertices - 0.5 * (np.array([width, height]) - 1)
    light = scene.illumination
    contrast = (_WHITE - _BLACK) * light.level * (1 + place @ (np.array(light.gradient) / [width, height]))
    result = np.full(contrast.shape, np.nan)
    for r, c in np.argwhere(np.isfinite(contrast)):
        if isinstance(truth.plane, CirclePlane):
            lines = _outline(scene, truth.plane, c, r)
            lengths = np.hypot(*lines.T)
            sigma = [edge_bound(noise, contrast[r, c], scene.sigma_t, length) for length in lengths]
        else:
            lines = np.array([_line(truth.vertices, r, c, step) for step in ((0, 1), (1, 0))])
            lengths = np.hypot(*lines.T)
            sigma = [vertex_bound(noise, contrast[r, c], scene.sigma_t, length) for length in lengths]
        across = lines[:, ::-1] * [-1, 1] / (lengths * sigma)[:, None]
        result[r, c] = 0.5 * np.trace(np.linalg.inv(across.T @ across))
    return result


def _line(vertices: Array, r: int, c: int, step: tuple[int, int]) -> Array:
    """The line through a vertex, from half of the way to the vertex before it to half of that to the next."""
    ends = []
    for sign in (1, -1):
        there = r + sign * step[0], c + sign * step[1]
        inside = all(0 <= at < size for at, size in zip(there, vertices.shape, strict=False))
        if inside and np.isfinite(vertices[there]).all():
            ends.append(sign * (vertices[there] - vertices[r, c]))
    return np.asarray(np.mean(ends, axis=0))


def _outline(scene: Scene, plane: CirclePlane, c: int, r: int) -> Array:
    """The outline of a circle in pieces."""
    centre = plane.truly_at(np.array([[c, r]], dtype=float))[0]
    circle = 0.5 * plane.diameter * np.stack([np.cos(ANGLES), np.sin(ANGLES), 0 * ANGLES], axis=1)
    seen = scene.camera.project((centre + circle) @ scene.pose.R.T + scene.pose.t)[0]
    return np.diff(seen, axis=0)


@dataclass
class Cell:
    """Sums over the vertices of each picture."""

    error: list[float] = field(default_factory=list)  # squared [px^2], of both axes
    bound: list[float] = field(default_factory=list)
    squared: list[float] = field(default_factory=list)  # over the covariance
    count: list[int] = field(default_factory=list)
    worst: float = 0.0
    visible: int = 0
    refused: int = 0
    others: dict[str, list[float]] = field(default_factory=dict)  # squared error, number of points

    def add(self, kind: str, condition: str, seed: int) -> None:
        """Measure one more picture."""
        scene = scene_of(kind, condition, seed)
        picture, hidden = picture_of(scene, condition, seed)
        (truth,) = picture.truth.planes
        square = KINDS[kind][1]
        seen = truth.vertices_visible & (truth.vertices[..., 0] < hidden - BESIDE * square)
        self.visible += int(seen.sum())
        for name, points in others(kind, truth.plane, picture.image).items():
            away = np.linalg.norm(points[:, None] - truth.vertices[seen][None], axis=2)
            near = away.min(axis=0, initial=NEAR)
            sums = self.others.setdefault(name, [0.0, 0.0])
            sums[0] += float((near[near < NEAR] ** 2).sum())
            sums[1] += int((near < NEAR).sum())
        try:
            found = detect_points(picture.image, scene.board, "vertices")
        except NeurocalError:
            self.refused += 1
            return
        rows, cols = seen.shape
        order = {name: k for k, name in enumerate(truth.vertex_ids)}
        r, c = np.divmod([order[name] for name in found.ids], cols)
        if kind in ("chessboard", "circles"):
            # These boards look the same after half a turn.
            both = (r, c), (rows - 1 - r, cols - 1 - c)
            r, c = min(both, key=lambda one: float(np.nanmax(np.abs(found.pixels - truth.vertices[one]))))
        used = seen[r, c]
        u, v = (found.pixels - truth.vertices[r, c])[used].T
        uu, uv, vv = found.covariance[used].T
        self.error.append(float((u * u + v * v).sum()))
        self.bound.append(float(2 * bounds(scene, picture)[r, c][used].sum()))
        self.squared.append(float(((vv * u * u - 2 * uv * u * v + uu * v * v) / (uu * vv - uv * uv)).sum()))
        self.count.append(int(used.sum()))
        self.worst = max(self.worst, float(np.abs([u, v]).max()))

    def __str__(self) -> str:
        ratio, off = _ratio(self.error, self.bound)
        squared, squared_off = _ratio(self.squared, [2 * n for n in self.count])
        rms = np.sqrt(np.sum(self.error) / (2 * np.sum(self.count)))
        text = (
            f"{np.sqrt(ratio):.2f} +- {off / (2 * np.sqrt(ratio)):.2f}, {squared:.2f} +- {squared_off:.2f}, "
            f"{rms:.4f} px, at most {self.worst:.3f}, {np.sum(self.count) / self.visible:.3f} of the vertices"
        )
        if self.refused:
            text += f", {self.refused} refused"
        for name, (total, count) in self.others.items():
            text += f"; {name} {np.sqrt(total / max(2 * count, 1)):.3f} px, {count / self.visible:.2f}"
        return text


def _ratio(parts: list[float], of: list[float]) -> tuple[float, float]:
    """Ratio of two sums, and its standard deviation."""
    first, second = np.array(parts), np.array(of)
    without = (first.sum() - first) / (second.sum() - second)
    return float(first.sum() / second.sum()), float(np.sqrt((len(first) - 1) * without.var()))


def others(kind: str, plane: object, image: Array) -> dict[str, Array]:
    """Points (N, 2) that other programs find."""
    assert hasattr(plane, "cols")
    assert hasattr(plane, "rows")
    size = (plane.cols, plane.rows)
    if kind == "chessboard":
        found, points = cv2.findChessboardCorners(image, size)
        if found:
            points = cv2.cornerSubPix(image, points.reshape(-1, 1, 2), (5, 5), (-1, -1), (3, 40, 1e-3))
        return {"OpenCV": _points(points if found else None)}
    if kind == "circles":
        found, points = cv2.findCirclesGrid(image, size, flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
        return {"OpenCV": _points(points if found else None)}
    if kind == "charuco":
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        board = cv2.aruco.CharucoBoard((10, 7), 28.0, 21.0, family)
        result = {"OpenCV": _points(cv2.aruco.CharucoDetector(board).detectBoard(image)[0])}
        try:
            from lensboy import extract_frames_from_charuco
        except ImportError:
            return result
        with redirect_stdout(StringIO()):
            frames = extract_frames_from_charuco(board, [image])[1]
        return {**result, "lensboy": _points(frames[0].detected_points_in_image if frames else None)}
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits, parameters.cornerRefinementMethod = 2, cv2.aruco.CORNER_REFINE_SUBPIX
    corners = cv2.aruco.ArucoDetector(family, parameters).detectMarkers(image)[0]
    result = {"OpenCV": _points(np.concatenate(corners) if len(corners) else None)}
    try:
        from aprilgrid import Detector
    except ImportError:
        return result
    tags = [tag.corners for tag in Detector("t36h11").detect(image)]
    return {**result, "aprilgrid": _points(np.concatenate(tags) if tags else None)}


def _points(found: Array | None) -> Array:
    return np.zeros((0, 2)) if found is None else np.asarray(found, dtype=float).reshape(-1, 2)


def main(first: int, number: int, cells: list[str]) -> None:
    """Print a line for each cell."""
    cv2.setNumThreads(1)
    for condition, kind in (cell.split("/") for cell in cells):
        cell = Cell()
        for seed in range(first, first + number):
            cell.add(kind, condition, seed)
        print(f"{condition}, {kind}: {cell}", flush=True)


if __name__ == "__main__":
    every = [f"{condition}/{kind}" for condition in CONDITIONS for kind in KINDS]
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:] or every)

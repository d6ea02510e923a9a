"""Make the sample photographs: a printed chessboard in a hand, rendered like the pictures of a phone.

The paper bends and ripples, a little differently each time, and the printer was not exact. The light is
uneven, things lie behind the board, a thumb holds its margin, and the pictures have the soft lens, the noise
that is partly smoothed, and the compression of a simple camera in a room. Run ``python
sample_data/make_photos.py`` to write the files again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.files.images import encode_image
from neurocal_cli.files.writing import write_whole

HERE = Path(__file__).resolve().parent
CAMERA = Camera(
    Intrinsics(562.0, 561.0, 323.0, 236.5), Distortion("k1k2", np.array([-0.21, 0.06])), (640, 480)
)
SQUARES, SIDE, MARGIN = (10, 7), 25.0, 15.0  # squares across and down, mm, mm of white paper around them
HALF = 0.5 * SIDE * np.array(SQUARES)  # of the pattern, from its middle [mm]
CURL, ANEW = 0.5, 0.1  # mm that the paper bends, in all pictures alike and anew in each
RIPPLE, RIPPLES = 0.07, 120.0  # mm: amplitude and length of the paper's waves, anew in each picture
PRINTED, PRINTS = 0.03, 60.0  # mm: the same of the printer's errors
WAVES = 4  # that make a surface of these
SEED = 100
FINE = 2  # rays across and down in each pixel
BLUR, SMOOTHED = 1.2, 0.8  # px, of the lens, and of the picture with its noise
FULL_WELL, READ, GAMMA, QUALITY = 40.0, 1.2, 2.2, 80
# Of each picture: where the board's middle is in the image, its distance [mm], tilt, side of the tilt, and
# roll [degrees].
VIEWS = (
    (0.50, 0.50, 330, 8, 0, 3), (0.40, 0.46, 350, 35, 20, -8), (0.61, 0.47, 350, 36, 110, 12),
    (0.38, 0.56, 380, 38, 200, 5), (0.62, 0.58, 370, 34, 290, -14), (0.30, 0.44, 430, 30, 60, 84),
    (0.71, 0.50, 430, 33, 150, 95), (0.32, 0.66, 400, 38, 245, -6), (0.67, 0.35, 400, 36, 330, 10),
    (0.36, 0.33, 430, 40, 90, 4), (0.49, 0.55, 460, 42, 270, 88), (0.66, 0.66, 420, 30, 180, 178),
)  # fmt: skip


def poses(views: Sequence[tuple[float, ...]] = VIEWS) -> Iterator[Pose]:
    """World to camera, with the middle of the pattern at the origin."""
    for u, v, distance, tilt, side, roll in views:
        ray = CAMERA.seen_points(np.array([[u * 639, v * 479]]))[0]
        turn = Pose.from_euler(0, 0, np.radians(side), np.zeros(3)).R
        R = turn @ Pose.from_euler(np.radians(tilt), 0, 0, np.zeros(3)).R @ turn.T
        R = R @ Pose.from_euler(0, 0, np.radians(roll), np.zeros(3)).R
        yield Pose(R, distance * ray)


def waves(rng: np.random.Generator, length: float) -> Array:
    """Waves in any direction, of about this length [mm]: their vectors and phases, (3, n)."""
    vectors = rng.normal(0, 2 * np.pi / length, (2, WAVES))
    return np.vstack([vectors, rng.uniform(0, 2 * np.pi, WAVES)])


def surface(x: Array, y: Array, made: Array) -> Array:
    """The sum of `waves` at places, of rms 1."""
    return np.asarray(sum(np.cos(k * x + m * y + phase) for k, m, phase in made.T) / np.sqrt(WAVES / 2))


PRINTER = [waves(np.random.default_rng(seed), PRINTS) for seed in (1, 2)]


def height(x: Array, y: Array, bend: Array) -> Array:
    """Height of the paper [mm] at places from its middle."""
    a, b = x / HALF[0], y / HALF[1]
    curved = bend[0] * (a * a - 1 / 3) + bend[1] * (b * b - 1 / 3) + bend[2] * a * b
    return np.asarray(curved + RIPPLE * surface(x, y, bend[3:].reshape(3, -1)))


def bent(rng: np.random.Generator, anew: float = ANEW) -> Array:
    """How the paper bends in a picture [mm], and its waves."""
    curved = CURL * np.array([1.0, -0.3, 0.4]) + anew * rng.standard_normal(3)
    return np.concatenate([curved, waves(rng, RIPPLES).ravel()])


def photograph(
    pose: Pose, bend: Array, rng: np.random.Generator, camera: Camera = CAMERA, moved: int = 1
) -> Array:
    """A picture in grey values from 0 to 255; the camera may have moved by some pixels while it was taken."""
    width, height_px = camera.image_size or (0, 0)
    step = (np.arange(FINE) + 0.5) / FINE - 0.5
    u = (np.arange(width)[:, None] + step).ravel()
    v = (np.arange(height_px)[:, None] + step).ravel()
    rays = camera.unproject(np.stack(np.meshgrid(u, v), axis=-1))
    direction, centre = rays @ pose.R, -pose.R.T @ pose.t  # in the paper's frame
    z = np.zeros(rays.shape[:2])
    for _ in range(3):
        along = (z - centre[2]) / direction[..., 2]
        x, y = (centre[k] + along * direction[..., k] for k in (0, 1))
        z = height(x, y, bend)
    on_paper = (np.abs(x) < HALF[0] + MARGIN) & (np.abs(y) < HALF[1] + MARGIN) & (along > 0)
    on_pattern = (np.abs(x) < HALF[0]) & (np.abs(y) < HALF[1])
    printed = [one + PRINTED * surface(x, y, errors) for one, errors in zip((x, y), PRINTER, strict=True)]
    dark = sum(np.floor((one + half) / SIDE) for one, half in zip(printed, HALF, strict=True)) % 2 == 0
    paper = np.where(on_pattern & dark, 0.05, 0.82)
    slope = 2 * bend[0] * x / HALF[0] ** 2
    light = 1.0 + 8.0 * slope + 0.0006 * (0.7 * x - y)
    scene = np.where(on_paper, paper * light, behind(rng, rays.shape[:2]))
    thumb(scene, pose, camera, rng)
    seen = scene.reshape(height_px, FINE, width, FINE).mean(axis=(1, 3))
    seen = cv2.blur(cv2.GaussianBlur(seen, (0, 0), BLUR), (moved, max(1, moved // 2)))
    rho = np.hypot(*np.meshgrid(np.linspace(-1, 1, width), np.linspace(-0.75, 0.75, height_px))) / 1.25
    seen = np.clip(seen * (0.86 - 0.2 * rho**2), 0, 1)
    electrons = rng.poisson(FULL_WELL * seen) + rng.normal(0, READ, seen.shape)
    electrons = cv2.GaussianBlur(electrons, (0, 0), SMOOTHED)
    return np.clip(255 * np.clip(electrons / FULL_WELL, 0, 1) ** (1 / GAMMA), 0, 255)


def behind(rng: np.random.Generator, size: tuple[int, int]) -> Array:
    """A wall with shelves and books, out of focus."""
    wall = cv2.resize(rng.uniform(0.2, 0.4, (7, 9)), size[::-1], interpolation=cv2.INTER_CUBIC)
    for _ in range(26):
        x, y = rng.uniform(0, 1, 2) * size[::-1]
        w, h = rng.uniform(20, 70) * FINE, rng.uniform(60, 220) * FINE
        corners = cv2.boxPoints(((x, y), (w, h), rng.normal(0, 4))).astype(np.int32)
        cv2.fillPoly(wall, [corners], float(rng.uniform(0.04, 0.55)))
    return np.asarray(cv2.GaussianBlur(wall, (0, 0), 2.2 * FINE))


def thumb(scene: Array, pose: Pose, camera: Camera, rng: np.random.Generator) -> None:
    """Draw a thumb over the white margin of the paper."""
    side = rng.choice([-1.0, 1.0])
    x, y = side * (HALF[0] + MARGIN), rng.uniform(-0.6, 0.6) * HALF[1]
    tip, root = (np.array([x - side * 8, y, 0.0]), np.array([x + side * 45, y + 12, 0.0]))
    ends = camera.project(pose.to_camera(np.array([tip, root])))[0]
    (a, b), scale = (ends + 0.5) * FINE, camera.A[0, 0] / pose.t[2] * FINE
    cv2.line(scene, a.astype(int).tolist(), b.astype(int).tolist(), 0.38, max(1, int(15 * scale)))
    cv2.circle(scene, a.astype(int).tolist(), int(7 * scale), 0.41, -1)


if __name__ == "__main__":
    for number, pose in enumerate(poses(), start=1):
        rng = np.random.default_rng(SEED + number)
        image = np.round(photograph(pose, bent(rng), rng)).astype(np.uint8)
        write_whole(str(HERE / f"photo{number:02d}.jpg"), encode_image(image, ".jpg", QUALITY))

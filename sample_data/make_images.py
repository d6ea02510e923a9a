"""Make the sample images: rendered chessboards, seeded noise, nothing photographed.

Run ``python sample_data/make_images.py`` to write the files again.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.files.images import encode_png
from neurocal_cli.files.writing import write_whole
from neurocal_cli.observations.board import Plane
from neurocal_cli.simulation.rendering.layers import visible_midpoints
from neurocal_cli.simulation.rendering.render import digitised, image_light
from neurocal_cli.simulation.rendering.scene import Background, Scene, Target

HERE = Path(__file__).resolve().parent
CAMERA = Camera(Intrinsics(510.0, 508.0, 202.5, 147.0), image_size=(400, 300))
BOARD = Target(Plane("", 9, 6, 25.0))
NOISE = 0.5  # grey values


def poses(n: int) -> Iterator[Pose]:
    """Poses that tilt the board 25-40 degrees to all sides, its centre near the image's."""
    rng = np.random.default_rng(7)
    centre = BOARD.plane.at([4.0, 2.5])
    for k in range(n):
        tilt, side, roll = np.radians(rng.uniform(25, 40)), 2 * np.pi * k / n, rng.uniform(-0.3, 0.3)
        turn = Pose.from_euler(0, 0, side, np.zeros(3)).R
        R = turn @ Pose.from_euler(tilt, 0, 0, np.zeros(3)).R @ turn.T
        R = R @ Pose.from_euler(0, 0, roll, np.zeros(3)).R
        t = np.array([rng.uniform(-15, 15), rng.uniform(-10, 10), rng.uniform(470, 540)])
        yield Pose(R, t - R @ centre)


if __name__ == "__main__":
    for number, pose in enumerate(poses(6), start=1):
        scene = Scene(CAMERA, pose, (BOARD,), Background(0.45), psf=0.7)
        if len(visible_midpoints(scene)) < len(BOARD.plane.midpoint_ids()):
            raise SystemExit("a board leaves the image: choose another pose")
        image = digitised(image_light(scene), np.random.default_rng(number), NOISE)
        write_whole(str(HERE / f"board{number:02d}.png"), encode_png(image))

"""Make the fisheye's sample data: a simulated lens, seeded noise, nothing measured.

Run ``python sample_data/make_fisheye.py`` to write ``fisheye.csv`` again, byte for byte.
The lens is written out here, so that it does not share an error with the program.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neurocal_cli import Board, Correspondences, Pose, write_points

HERE = Path(__file__).resolve().parent
SIZE = (640, 480)
ALPHA, CENTRE = 285.0, np.array([322.0, 238.0])
K = (0.02, -0.012, 0.006, -0.002)
SIGMA = 0.1  # px, of the simulated detector


def seen(points: np.ndarray) -> np.ndarray:
    """Pixels of points in the camera's frame: the radius is a polynomial of the angle to the axis."""
    across = np.hypot(points[:, 0], points[:, 1])
    angle = np.arctan2(across, points[:, 2])
    radius = angle * (1 + sum(k * angle ** (2 * n) for n, k in enumerate(K, start=1)))
    return CENTRE + ALPHA * (radius / across)[:, None] * points[:, :2]


def views() -> Correspondences:
    """Nine views of a flat board of 9 x 6 vertices, 25 mm squares, spread to the image's corners."""
    board = Board.single(9, 6, 25.0).planes[0]
    ids, world = board.vertex_ids(), board.vertices().reshape(-1, 3)
    rng = np.random.default_rng(11)
    centre = world.mean(axis=0)
    pixels, names = [], []
    for number in range(9):
        aside, down = (number % 3 - 1) * 0.85, (number // 3 - 1) * 0.6
        # The board faces the camera from the side where it stands, and is tilted further.
        facing = Pose.from_euler(
            -down + rng.uniform(-0.4, 0.4), aside + rng.uniform(-0.4, 0.4), 0.1, np.zeros(3)
        ).R
        towards = np.array([np.tan(aside), np.tan(down), 1.0])
        place = rng.uniform(190, 240) * towards / np.linalg.norm(towards)
        ideal = seen((world - centre) @ facing.T + place)
        pixels.append(np.round(ideal + SIGMA * rng.normal(size=ideal.shape), 4))
        names += [f"view{number + 1}"] * len(world)
    found = np.concatenate(pixels)
    keep = ((found >= 0) & (found <= np.array(SIZE) - 1)).all(axis=1)
    return Correspondences(
        np.tile(world, (9, 1))[keep],
        found[keep],
        view=np.array(names)[keep],
        point=np.tile(ids, 9)[keep],
        image_size=SIZE,
    )


if __name__ == "__main__":
    write_points(views(), str(HERE / "fisheye.csv"))

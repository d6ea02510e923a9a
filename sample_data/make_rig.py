"""Make the sample rig: three simulated cameras in a line, which see a board of 6 x 5 corners in 15 frames.

Run ``python sample_data/make_rig.py`` to write the files again, byte for byte.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from neurocal_cli.files.points_csv import write_points
from neurocal_cli.simulation.rigs import SimulatedRig, random_rig

HERE = Path(__file__).resolve().parent
SIGMA = 0.1  # px

# Points in the first camera's frame [mm]; the last is moved by 9 px in the second camera.
POINTS = np.array(
    [[0.0, 0.0, 2400.0], [300.0, -200.0, 2500.0], [-250.0, 150.0, 2200.0], [100.0, 120.0, 2600.0]]
)


def sightings(rig: SimulatedRig) -> str:
    """Pixels of the points in all three cameras, to a hundredth of a pixel."""
    lines = ["point,camera,u,v"]
    for name, camera in rig.cameras.items():
        pixels = camera.project(rig.relative[name].to_camera(POINTS))[0]
        pixels[-1] += 9.0 * (name == "cam1")
        lines += [f"p{k},rig_{name},{u:.2f},{v:.2f}" for k, (u, v) in enumerate(pixels)]
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    rng = np.random.default_rng(8)
    rig = random_rig("line", 3, 15, rng)
    for name, points in rig.points(SIGMA, rng).items():
        write_points(replace(points, pixels=np.round(points.pixels, 5)), str(HERE / f"rig_{name}.csv"))
    (HERE / "sightings.csv").write_text(sightings(rig))

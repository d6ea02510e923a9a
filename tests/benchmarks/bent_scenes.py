"""Times of thirty scenes of 13 views through strong distortion, beside OpenCV's `calibrateCamera`.

Run with ``PYTHONPATH=tests python tests/benchmarks/bent_scenes.py``.
"""

import conftest  # noqa: F401 - one thread, before NumPy loads its BLAS

# isort: split
import time
from collections.abc import Callable

import cv2
import numpy as np
from support.distorted import through
from support.scenes import random_flat_set

from neurocal_cli import calibrate

COEFFICIENTS = [-0.28, 0.05, 0.001, -0.001, 0.02]
VIEWS, SCENES, RUNS = 13, 30, 9


def time_of(run: Callable[[], object]) -> float:
    """Time of one run [ms]."""
    begun = time.perf_counter()
    run()
    return 1e3 * (time.perf_counter() - begun)


def scene(seed: int) -> tuple[float, float, float, float]:
    """Median times [ms] and rms errors [px] of neurocal and of OpenCV, which run in turn."""
    flat = random_flat_set(np.random.default_rng(seed), VIEWS, False, cols=9, rows=6)
    points = through(flat, "plumb_bob", COEFFICIENTS).points(0.3, np.random.default_rng(seed))
    world = list(points.world.reshape(VIEWS, -1, 3).astype(np.float32))
    pixels = list(points.pixels.reshape(VIEWS, -1, 2).astype(np.float32))

    def ours() -> float:
        found = calibrate(points, skew=False, distortion="plumb_bob", outliers="keep", target="given")
        return found.rmse_px

    def theirs() -> float:
        return float(cv2.calibrateCamera(world, pixels, points.image_size, None, None)[0])

    errors = ours(), theirs()
    times = np.median([(time_of(ours), time_of(theirs)) for _ in range(RUNS)], axis=0)
    return float(times[0]), float(times[1]), *errors


def main() -> None:
    """Print a line per scene and the median of the ratios."""
    cv2.setNumThreads(1)
    ratios = []
    print("scene  neurocal [ms]  OpenCV [ms]  ratio  rms [px]")
    for seed in range(SCENES):
        own, other, error, error_of_opencv = scene(seed)
        ratios.append(own / other)
        print(f"{seed:5}  {own:13.1f}  {other:11.1f}  {own / other:5.2f}  {error:.4f} {error_of_opencv:.4f}")
    print(f"median ratio {np.median(ratios):.2f}")


if __name__ == "__main__":
    main()

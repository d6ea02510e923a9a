"""``neurocal triangulate --plane``: pixels of one camera in, points on the plane of a view's target out."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.calibration.verdict.findings import two_digits
from neurocal_cli.commands.streams import end_waiting, note, print_summary, say, warn
from neurocal_cli.errors import InputError, plural
from neurocal_cli.files.calibration_yaml import read_calibration
from neurocal_cli.files.measurement_csv import Batch, format_plane_points, read_pixels
from neurocal_cli.files.writing import write_chunks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neurocal_cli.camera.measured import PlanePoints


def points_on_plane(
    camera: str, pixels: str, view: str, sigma: float | None, as_json: bool, output: str
) -> None:
    """Convert the pixels of a file, and say how certain the points are."""
    calibration = read_calibration(camera)
    calibration.pose_of(view)
    if sigma is None and not np.isfinite(calibration.sigma):
        raise InputError(f"{camera} does not say how accurate its pixels are; give --sigma")
    sigma = calibration.sigma if sigma is None else sigma
    verdict = calibration.verdict
    if verdict is not None and verdict.word == "poor":
        warn(f"the calibration is poor: {'; '.join(verdict.reasons[:1])}; points may be far off")
    if calibration.points.undistorted:
        note("the camera was calibrated from undistorted points; undistort its pixels alike")
    notes: list[str] = []
    batches = read_pixels(pixels, notes)
    # The first rows are read before the output is opened, so that errors in the header leave it untouched.
    batches = chain([next(batches)], batches)
    note(*notes)
    missed, variances = 0, np.zeros((0, 2))

    def located(batches: Iterator[Batch]) -> Iterator[tuple[PlanePoints, NDArray[Any] | None]]:
        nonlocal missed, variances
        for seen, labels in batches:
            found = calibration.on_plane(seen, view, sigma)
            missed += int((~found.seen).sum())
            of_pixel = np.trace(found.by_pixel, axis1=1, axis2=2)
            known = found.by_calibration
            of_camera = np.full(len(seen), np.nan) if known is None else np.trace(known, axis1=1, axis2=2)
            variances = np.concatenate([variances, np.column_stack([of_camera, of_pixel])[found.seen]])
            yield found, labels

    end_waiting()
    write_chunks(output, format_plane_points(located(batches), view=view, unit=calibration.unit, sigma=sigma))
    of_camera, of_pixel = np.sqrt(np.median(variances, axis=0)).tolist() if len(variances) else [np.nan] * 2
    if as_json:
        parts = {"calibration": of_camera, "pixels": of_pixel}
        print_summary({"n_points": len(variances) + missed, "n_behind": missed, "std": parts})
        return
    told = [plural(len(variances) + missed, "point")]
    told += [f"{missed} of them not on the plane in front of the camera"] if missed else []
    if np.isfinite(of_pixel):
        shares = [f"{two_digits(of_pixel)} {calibration.unit} by the pixels"]
        shares += [f"{two_digits(of_camera)} by the calibration"] if np.isfinite(of_camera) else []
        told.append(f"std {' and '.join(shares)}")
    say(", ".join(told))

"""``neurocal triangulate``: pixels of two cameras or more in, points in space out; of one, on a plane."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from itertools import chain
from typing import TYPE_CHECKING, Any

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.streams import end_waiting, note, noted, summarise, warn
from neurocal_cli.errors import InputError, UsageError, plural
from neurocal_cli.files.writing import write_chunks

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from neurocal_cli.calibration.rig.rig import Rig, StereoRig
    from neurocal_cli.calibration.rig.triangulation import Triangulated
    from neurocal_cli.camera.geometry import Array
    from neurocal_cli.camera.measured import PlanePoints
    from neurocal_cli.files.measurement_csv import Batch
    from neurocal_cli.files.table_header import Schema

_USUAL_SIGMA = 0.5  # px; default for a rig without points
_MOST_NOISE = 2.0  # px; more is a mistake and not noise
_LARGEST_SIGMA = 1e6  # px; no image is that large
_SAMPLE = 1000  # points whose fault is looked for
_MANY_OFF = 0.5  # share of the points that chance does not explain


@click.command(cls=options.Command)
@options.argument(
    "inputs",
    "RIG.yaml MATCHES.csv",
    "A rig, or LEFT.yaml RIGHT.yaml, two calibrations with a view in common; then a CSV file of "
    "pixels with the columns uL,vL,uR,vR and optionally point, or, of a rig of any number of cameras, "
    "point,camera,u,v. - is standard input.",
    nargs=-1,
    required=True,
)
@options.number(
    "--sigma",
    "PX",
    "Standard deviation of the pixels, in u and in v, for the covariances.",
    without="the noise of the rig's own points, or 0.5 if it does not state any",
    positive=True,
)
@options.number(
    "--epipolar-limit",
    "PX",
    "Flag points whose pixels must be moved by more than this for their rays to meet; of any number of "
    "cameras, those with a larger error.",
    without="5 sigma",
    positive=True,
)
@options.path(
    "--plane",
    "VIEW",
    "Of a single camera: compute points on the plane of the target of this view, such as a board that "
    "lay on a table. Give CAMERA.yaml and a CSV file with the columns u,v and optionally point.",
)
@options.summary
@options.output("XYZ.csv", "Write the points to this file.")
def triangulate(
    inputs: tuple[str, ...],
    sigma: float | None,
    epipolar_limit: float | None,
    plane: str | None,
    as_json: bool,
    output: str,
) -> None:
    """Compute points in space from their pixels in two images or more.

    Give the pixels of the original images, neither undistorted nor rectified. The command computes the
    point with the smallest squared reprojection error. It writes a row with these columns for each point:

    \b
      X, Y, Z     the point in the frame of the left camera (X right, Y down,
                  Z forward), in the unit of the calibration
      sXX to sZZ  its covariance, for pixels of standard deviation --sigma and
                  cameras without error
      epipolar    the smallest shift of both pixels that makes their rays meet
      flag        ok, or off: the pixels are too far from their epipolar lines,
                  or behind: the point is behind a camera or at infinity

    With a rig of any number of cameras, each row of the pixels is a point in one camera: point,camera,u,v.
    The output has a row for each point, in the frame of the first camera, with these columns instead of
    epipolar:

    \b
      error       rms distance of its pixels from its images, per degree of freedom
      cameras     number of cameras that were used
      without     the camera that contradicts the others and was left out, if any

    With --plane, a single camera is enough: each pixel shows the point of the plane on its ray. The plane is
    Z = 0 of the target in a view of the calibration, and X, Y, Z are in the target's coordinates. The
    covariance sXX, sXY, sYY is that of the pixel and of the calibration with the pose of the view.

    If the rays of a row do not determine a point, its X, Y and Z are nan. No row is dropped. The rows are
    processed in batches, so the file may have any length.

    \b
    Examples:
      neurocal sample sample_data
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          -o rig.yaml
      neurocal triangulate rig.yaml sample_data/matches.csv -o xyz.csv
      neurocal triangulate rig.yaml sample_data/matches.csv --sigma 0.3 \\
          --epipolar-limit 2 --json -o xyz.csv
      cat sample_data/matches.csv | neurocal triangulate rig.yaml - > xyz.csv
      neurocal rig sample_data/rig_cam0.csv sample_data/rig_cam1.csv \\
          sample_data/rig_cam2.csv -o three.yaml
      neurocal triangulate three.yaml sample_data/sightings.csv -o xyz.csv
      neurocal calibrate sample_data/flat.csv -o camera.yaml
      echo 320,240 | neurocal triangulate camera.yaml - --plane view01
    """  # noqa: D301 - as in the group
    if len(inputs) not in (2, 3):
        given = plural(len(inputs), "file")
        raise UsageError(f"{given} given; give RIG.yaml MATCHES.csv, or LEFT.yaml RIGHT.yaml MATCHES.csv")
    if sigma is not None and sigma > _LARGEST_SIGMA:
        raise UsageError(f"--sigma is {sigma:g}; give the standard deviation of the pixels, such as 0.3")
    preparation.check(inputs, (output,), as_json=as_json)
    if plane is not None:
        if len(inputs) != 2:
            raise UsageError("--plane is of a single camera; give CAMERA.yaml PIXELS.csv")
        options.note_unused("with --plane", "epipolar_limit")
        _on_plane(inputs[0], inputs[1], plane, sigma, as_json, output)
        return
    from neurocal_cli.files.camera_tree import own_kind, read_tree
    from neurocal_cli.files.measurement_csv import MATCHES, format_space_points, has_sightings

    if len(inputs) == 2 and (has_sightings(inputs[1]) or own_kind(read_tree(inputs[0])) == "rig"):
        _triangulate_many(inputs[0], inputs[1], sigma, epipolar_limit, as_json, output)
        return
    rig = _rig(inputs[:-1])
    for side, camera in (("left", rig.left), ("right", rig.right)):
        if camera.points.undistorted:
            note(f"the {side} camera was calibrated from undistorted points; undistort its pixels alike")
    sigma, limit = _accuracy(rig, sigma, epipolar_limit)
    tally = _Tally(rig, sigma, limit)
    matches = _begun(inputs[-1], MATCHES)
    end_waiting()
    write_chunks(
        output, format_space_points(tally.triangulated(matches), unit=rig.unit, sigma=sigma, limit=limit)
    )
    tally.tell(as_json)


def _accuracy(rig: Rig, sigma: float | None, limit: float | None) -> tuple[float, float]:
    """The noise of pixels, else that of the rig's own points or what is usual, and the limit of errors."""
    from neurocal_cli.calibration.rig.triangulation import epipolar_limit

    if sigma is None and math.isnan(rig.sigma):
        note(f"the rig does not say how accurate its pixels are; {_USUAL_SIGMA} px is assumed; give --sigma")
    usual = _USUAL_SIGMA if math.isnan(rig.sigma) else rig.sigma
    sigma = usual if sigma is None else sigma
    return sigma, epipolar_limit(sigma) if limit is None else limit


def _begun(file: str, schema: Schema) -> Iterator[Batch]:
    """Batches of a file, the first of which is read now, so that errors there leave the output untouched."""
    from neurocal_cli.files.measurement_csv import read_pixels

    notes: list[str] = []
    batches = read_pixels(file, schema, notes)
    batches = chain([next(batches)], batches)
    note(*notes)
    return batches


def _on_plane(camera: str, pixels: str, view: str, sigma: float | None, as_json: bool, output: str) -> None:
    """Convert pixels to points on the plane of a view's target, and say how certain they are."""
    import numpy as np

    from neurocal_cli.calibration.verdict.findings import two_digits
    from neurocal_cli.files.calibration_yaml import read_calibration
    from neurocal_cli.files.measurement_csv import PIXELS, format_plane_points

    calibration = read_calibration(camera)
    calibration.pose_of(view)
    if sigma is None and not np.isfinite(calibration.sigma):
        raise InputError(f"{camera} does not say how accurate its pixels are; give --sigma")
    sigma = calibration.sigma if sigma is None else sigma
    preparation.warn_of_poor("calibration", calibration, "; points may be far off")
    if calibration.points.undistorted:
        note("the camera was calibrated from undistorted points; undistort its pixels alike")
    batches = _begun(pixels, PIXELS)
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
    told = [plural(len(variances) + missed, "point")]
    told += [f"{missed} of them not on the plane in front of the camera"] if missed else []
    if np.isfinite(of_pixel):
        shares = [f"{two_digits(of_pixel)} {calibration.unit} by the pixels"]
        shares += [f"{two_digits(of_camera)} by the calibration"] if np.isfinite(of_camera) else []
        told.append(f"std {' and '.join(shares)}")
    std = {"calibration": of_camera, "pixels": of_pixel}
    counts = {"n_points": len(variances) + missed, "n_behind": missed, "std": std}
    summarise(as_json, counts, ", ".join(told))


def _triangulate_many(
    file: str, matches: str, sigma: float | None, limit: float | None, as_json: bool, output: str
) -> None:
    """Triangulate points from any number of cameras."""
    from neurocal_cli.calibration.rig.many_views import triangulate_many
    from neurocal_cli.files.measurement_csv import format_many_points, read_sightings
    from neurocal_cli.files.rig_yaml import read_rig

    rig = read_rig(file)
    preparation.warn_of_poor("rig", rig, "; points in space may be far off")
    seen = noted(read_sightings, matches)
    sigma, limit = _accuracy(rig, sigma, limit)
    found = triangulate_many(rig, seen.point, seen.camera, seen.pixels, limit=limit)
    names = list(rig.cameras)
    text = format_many_points(found, seen.names, names, unit=rig.unit, sigma=sigma, limit=limit)
    end_waiting()
    write_chunks(output, text)
    off = int((~found.behind & ~(found.error <= limit)).sum())
    behind, without = int(found.behind.sum()), int((found.contradicts >= 0).sum())
    parts = [plural(len(found.points), "point")]
    parts += [f"{off} with an error above {limit:.3g} px"] if off else []
    parts += [f"{behind} behind a camera, at infinity or seen by one camera only"] if behind else []
    if without:
        worst = max(range(len(names)), key=lambda k: int((found.contradicts == k).sum()))
        count = int((found.contradicts == worst).sum())
        parts.append(
            f"{without} of them measured without a camera that contradicts the others, mostly "
            f"{names[worst]} ({count})"
        )
    counts = {"n_points": len(found.points), "n_off": off, "n_behind": behind, "n_without": without}
    summarise(as_json, {**counts, "error_limit_px": limit}, ", ".join(parts))
    # With all cameras: without those that contradict, what is left looks more accurate than it is.
    whole = triangulate_many(rig, seen.point, seen.camera, seen.pixels) if without else found
    several = whole.n_cameras > 1
    _warned_of_noise(sigma, whole.error[several], 2 * whole.n_cameras[several] - 3)


def _rig(names: tuple[str, ...]) -> StereoRig:
    """The rig of the file, or one that is fitted to two calibrations."""
    if len(names) == 1:
        from neurocal_cli.files.rig_yaml import read_stereo_rig

        rig = read_stereo_rig(names[0])
        preparation.warn_of_poor("rig", rig, "; points in space may be far off")
        return rig
    from neurocal_cli.calibration.rig.calibrate_rig import fit_stereo
    from neurocal_cli.files.calibration_yaml import read_calibration

    left, right = (read_calibration(name) for name in names)
    rig = fit_stereo(left, right)
    views = plural(len(rig.pairs), "view")
    note(f"the rig is fitted to {views} of both cameras: baseline {rig.baseline:.6g} {rig.unit}")
    warn(*rig.warnings)
    if not rig.warnings:
        preparation.warn_of_poor("rig", rig, "; points in space may be far off")
    return rig


def _warned_of_noise(sigma: float, errors: Array, dof: NDArray[np.intp] | int = 1) -> bool:
    """Warn of covariances that are too small, because the pixels are less accurate than those of the rig."""
    from neurocal_cli.calibration.rig.triangulation import noise_beyond

    noise = noise_beyond(sigma, errors, dof)
    if noise is None or noise > _MOST_NOISE:
        return False
    warn(
        f"the pixels of a point disagree as those of noise {noise:.2g} px do, but the covariances are for "
        f"{sigma:.2g} px; give --sigma {noise:.2g} if the pixels are no more accurate"
    )
    return True


class _Tally:
    """Triangulates batch by batch and counts what is wrong with the points."""

    def __init__(self, rig: StereoRig, sigma: float, limit: float) -> None:
        self.rig, self.sigma, self.limit = rig, sigma, limit
        self.points = self.behind = self.off = self.outside = 0
        self.first: Array | None = None  # the first batch, a sample for the cause of what is wrong
        self.errors: Array | None = None  # its epipolar errors

    def triangulated(self, batches: Iterable[Batch]) -> Iterator[tuple[Triangulated, Any]]:
        """The points of each batch of matches, and their names."""
        from neurocal_cli.calibration.rig.triangulation import triangulate as solve

        rig = self.rig
        for pixels, labels in batches:
            left, right = pixels[:, :2], pixels[:, 2:]
            found = solve(rig, left, right)
            if self.first is None:
                self.first, self.errors = pixels, found.epipolar
            self.points += len(pixels)
            self.behind += int(found.behind.sum())
            self.off += int((found.off(self.limit) & ~found.behind).sum())
            for camera, own in ((rig.left, left), (rig.right, right)):
                if camera.image_size is not None:
                    inside = (own > -1).all(axis=1) & (own < camera.image_size).all(axis=1)
                    self.outside += len(own) - int(inside.sum())
            yield found, labels

    def tell(self, as_json: bool) -> None:
        """Report the outcome on stderr, or as JSON on stdout."""
        parts = [plural(self.points, "point")]
        if self.off:
            are, lines = ("is", "its epipolar line") if self.off == 1 else ("are", "their epipolar lines")
            parts.append(f"{self.off} of them {are} more than {self.limit:.3g} px off {lines}")
        if self.behind:
            are = "is" if self.behind == 1 else "are"
            parts.append(f"{self.behind} {are} behind a camera or at infinity")
        counts = {"n_points": self.points, "n_off": self.off, "n_behind": self.behind}
        counts["n_outside"] = self.outside
        summarise(as_json, {**counts, "epipolar_limit_px": self.limit}, ", ".join(parts))
        if self.outside:
            warn(
                f"{self.outside} pixels lie outside the images; check that the pixels are of these cameras "
                "or, if they are of resized images, make their rig: neurocal resize RIG.yaml --to W H "
                "-o RESIZED.yaml"
            )
        many, fault = self.off + self.behind > _MANY_OFF * self.points, ""
        assert self.first is not None
        assert self.errors is not None
        if many:
            from neurocal_cli.calibration.rig.match_mistakes import fault_of_matches
            from neurocal_cli.calibration.rig.triangulation import epipolar_limit as usual_limit

            left, right = self.first[:_SAMPLE, :2], self.first[:_SAMPLE, 2:]
            # Matches may be less accurate than the rig's own points.
            limits = (self.limit, max(self.limit, usual_limit(_USUAL_SIGMA)))
            faults = (fault_of_matches(self.rig, left, right, limit) for limit in limits)
            fault = next(filter(None, faults), "")
        if not fault and _warned_of_noise(self.sigma, self.errors):
            return
        if many:
            fault = fault or (
                "check that uL,vL are pixels of the left camera, that the pixels are neither undistorted nor "
                "rectified, and the order of the matches"
            )
            warn(f"most points are flagged off or behind; {fault}")

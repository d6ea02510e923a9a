"""``neurocal rectify``: rectify pairs of images and points, so that their rows correspond."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.streams import each_of, note, noted, print_summary, say, warn, warned
from neurocal_cli.errors import FormatError, UsageError, plural, value_failures
from neurocal_cli.files.image_files import find_images, is_image, view_names
from neurocal_cli.files.writing import make_folder, write_whole

if TYPE_CHECKING:
    from neurocal_cli.calibration.rig.rectification import RectifiedPair, RowError
    from neurocal_cli.calibration.rig.rig import StereoRig
    from neurocal_cli.camera.remapping import Remapping
    from neurocal_cli.files.exchange.format_table import CameraSet
    from neurocal_cli.observations.points import Correspondences

_Paths = tuple[tuple[str, ...], tuple[str, ...]]  # of the left and of the right camera
_SIDES = ("left", "right")
# Median difference of rows, as a multiple of that of the rig's own points, and in px: 1 for other points of
# the rig, 5 if one file is given twice; test_cli_rectify.py.
_MISFIT, _NO_MISFIT = 3.0, 0.1


@click.command(cls=options.Command)
@options.argument(
    "rig",
    "RIG.yaml",
    "A rig of neurocal, or of another program that neurocal convert reads; - is standard input.",
)
@options.argument(
    "files",
    "LEFT... RIGHT...",
    "Images of the left camera and as many of the right one, in the same order: files, file name "
    "patterns or one folder each. Or CSV files of points.",
    nargs=-1,
)
@options.path(
    "--cameras", "LEFT RIGHT", "Names of two cameras of a rig that has more.", without="left and right"
)
@options.alpha("not scaled")
@options.interpolation
@options.flag(
    "--side-by-side", "Also write each pair as one picture with lines along the rows, to DIR/pairs."
)
@options.flag("--maps", "Also write DIR/maps.npz: tables for cv2.remap, and R1, R2, P1, P2, Q.")
@options.json
@options.output("DIR", "Write to the folders left and right in this folder.", required=True)
def rectify(
    rig: str,
    files: tuple[str, ...],
    cameras: tuple[str, str] | None,
    alpha: float | None,
    interpolation: str,
    side_by_side: bool,
    maps: bool,
    as_json: bool,
    output: str,
) -> None:
    """Rectify pairs of images and points of two cameras.

    The results are those of two cameras without distortion whose rows correspond: a point is in the same row
    of both images. For cameras above each other it is in the same column. R1, R2, P1, P2 and Q are those of
    OpenCV's stereoRectify.

    The left images come first, then the right ones. Images become PNG files with the names of the inputs,
    CSV files of points stay CSV files. The command prints the difference of corresponding rows in pixels, for
    the rig's own points and for the given points. A pair with an image that cannot be used is reported and
    left out.

    \b
    Examples:
      neurocal sample sample_data
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          -o rig.yaml
      neurocal rectify rig.yaml sample_data/stereo_left.csv \\
          sample_data/stereo_right.csv --maps -o rectified
      neurocal detect sample_data/board*.png --cols 9 --rows 6 --square 25 \\
          -o points.csv
      neurocal calibrate points.csv -o left.yaml
      neurocal convert left.yaml --to kalibr -o cam0.yaml
      (echo cam0:; sed "1d" cam0.yaml; echo cam1:; sed "1d" cam0.yaml; \\
          echo "   T_cn_cnm1: [[1,0,0,-0.1],[0,1,0,0],[0,0,1,0],[0,0,0,1]]") \\
          > camchain.yaml
      neurocal rectify camchain.yaml "sample_data/board0[123].png" \\
          "sample_data/board0[456].png" --alpha 0 --interpolation linear \\
          --side-by-side --json -o pairs
      neurocal rig sample_data/rig_cam0.csv sample_data/rig_cam1.csv \\
          sample_data/rig_cam2.csv -o three.yaml
      neurocal rectify three.yaml --cameras rig_cam0 rig_cam2 --maps -o maps
    """  # noqa: D301 - as in the group
    preparation.check_one_stdin(rig, *files)
    if not files and not maps:
        raise UsageError("there is nothing to rectify; give LEFT and RIGHT, or --maps")
    preparation.check_folder("-o", output)
    sides = _sides(files)
    images = bool(files) and is_image(sides[0][0])
    if not images:
        options.note_unused("without images", "interpolation", "side_by_side")
    preparation.check_outputs((), (*sides[0], *sides[1]))
    from neurocal_cli.calibration.rig.rectification import rectified_pair
    from neurocal_cli.files.exchange.reading import read_cameras

    found = _pair(warned(read_cameras, [rig]), rig, cameras)
    work = _Work(found, rectified_pair(found, alpha), interpolation, output, side_by_side, as_json)
    work.tell_rows_of_rig()
    if maps:
        work.write_maps()
    if images:
        work.rectify_images(sides)
    elif files:
        work.rectify_points(sides)
    if as_json:
        print_summary(work.summary)


def _sides(files: Sequence[str]) -> _Paths:
    """Files of the first and of the second half of the arguments."""
    if len(files) % 2:
        raise UsageError(
            f"{plural(len(files), 'name')} given; give as many for the right camera as for the left"
        )
    half = len(files) // 2
    left, right = find_images(files[:half]), find_images(files[half:])
    if len(left) != len(right):
        raise UsageError(
            f"there are {len(left)} left and {len(right)} right images; give the same number, in pairs"
        )
    for paths in (left, right):
        view_names(paths)  # no name twice
    return left, right


def _pair(cameras: CameraSet, file: str, names: tuple[str, str] | None) -> StereoRig:
    """Two cameras of a file as a stereo rig."""
    from neurocal_cli.files.exchange.neurocal import as_rig, as_stereo

    count = len(cameras.cameras)
    if names is not None and count > 1:
        return as_rig(cameras).pair(*names)
    if count > 2:
        told = ", ".join(camera.name for camera in cameras.cameras)
        raise UsageError(f"{file} holds {count} cameras ({told}); choose two by --cameras LEFT RIGHT")
    if count < 2:
        raise FormatError(f"holds {plural(count, 'camera')}; give the file of a rig of two or more", file)
    return as_stereo(cameras)


@dataclass
class _Work:
    """A rig, its rectified cameras, and the folders of the results."""

    rig: StereoRig
    pair: RectifiedPair
    interpolation: str
    output: str
    side_by_side: bool
    as_json: bool
    summary: dict[str, Any] = field(default_factory=dict)
    own_rows: RowError | None = None

    @property
    def along(self) -> str:
        """What corresponds in both images."""
        return "rows" if self.pair.axis == 0 else "columns"

    @cached_property
    def remappings(self) -> list[Remapping]:
        """Tables of both cameras' images, made only for images or for files of tables."""
        from neurocal_cli.camera.remapping import Remapping

        sides = zip(self.pair.originals, self.pair.cameras, self.pair.rotations, strict=True)
        return [
            Remapping(original, new, cast("tuple[int, int]", new.image_size), self.interpolation, R)
            for original, new, R in sides
        ]

    def tell_rows_of_rig(self) -> None:
        """Report the difference of corresponding rows for the rig's own points."""
        from neurocal_cli.calibration.rig.rectification import row_error_of_rig

        self.summary["along"] = self.along
        error = self.own_rows = row_error_of_rig(self.rig, self.pair)
        if error is not None:
            points = f"the rig's own {error.n_points} points"
            self._tell(f"{self.along} of {points} differ by {error.rms_px:.3g} px rms")
            self.summary["rig"] = {"n_points": error.n_points, "rms_px": error.rms_px}
        preparation.warn_of_poor("rig", self.rig)

    def rectify_points(self, sides: _Paths) -> None:
        """Rectify the points of both cameras and write them."""
        from neurocal_cli.calibration.rig.rectification import row_error
        from neurocal_cli.files.points_csv import format_points

        if len(sides[0]) > 1:
            raise UsageError("give one CSV file of points for each camera")
        moved = [self._rectified(side, path) for side, (path,) in enumerate(sides)]
        for name, (path,), points in zip(_SIDES, sides, moved, strict=True):
            self._write(os.path.join(name, os.path.basename(path)), format_points(points))
        error = row_error(self.pair, moved[0], moved[1])
        self.summary["points"] = {
            "n_points": error.n_points,
            "rms_px": error.rms_px,
            "max_px": error.max_px,
        }
        self._tell(
            f"{self.along} of the {error.n_points} points given differ by {error.rms_px:.3g} px "
            f"rms, {error.max_px:.3g} px at most"
        )
        if self.own_rows and error.median_px > max(_MISFIT * self.own_rows.median_px, _NO_MISFIT):
            warn(
                "most points do not fit the rig; check that LEFT and RIGHT are of its two cameras, that "
                "the cameras have not moved, and that the pixels are neither undistorted nor rectified"
            )

    def _rectified(self, side: int, path: str) -> Correspondences:
        """Read and rectify the points of one camera, 0 left or 1 right."""
        from neurocal_cli.calibration.calibration import undistorted_before
        from neurocal_cli.calibration.rig.rectification import rectify_points
        from neurocal_cli.files.points_csv import read_points

        points = noted(read_points, path)
        warn(*undistorted_before(points, (self.rig.left, self.rig.right)[side]))
        moved = rectify_points(self.pair, side, points)
        if len(moved) < len(points):
            note(
                f"{points.source}: {len(points) - len(moved)} of {len(points)} points are left out, "
                "which are 90 degrees from the rectified camera's axis or more"
            )
        return moved

    def rectify_images(self, sides: _Paths) -> None:
        """Rectify all pairs; those that fail are named and left out."""
        pairs = list(zip(*sides, strict=True))
        done = len(pairs) - len(each_of(pairs, self._rectify_pair, "pairs", "rectified"))
        self.summary["images"] = {"pairs": len(pairs), "rectified": done}
        self._tell(f"rectified {done} of {plural(len(pairs), 'pair')}")

    def _rectify_pair(self, pair: tuple[str, str]) -> None:
        """Rectify two images and write them, and the picture of both if it is wanted."""
        from neurocal_cli.calibration.rig.rectification import pair_picture
        from neurocal_cli.files.images import encode_image, encode_png, read_picture

        pictures = []
        for remapping, path in zip(self.remappings, pair, strict=True):
            pixels, source, notes = read_picture(path)
            note(*(f"{source}: {text}" for text in notes))
            with value_failures(source):
                pictures.append(remapping(pixels))
        names = [os.path.splitext(os.path.basename(path))[0] for path in pair]
        for side, name, pixels in zip(_SIDES, names, pictures, strict=True):
            self._write(os.path.join(side, f"{name}.png"), encode_image(pixels, ".png"))
        if self.side_by_side:
            drawn = pair_picture(pictures[0], pictures[1], self.pair.axis)
            shown = names[0] if names[0] == names[1] else "-".join(names)
            self._write(os.path.join("pairs", f"{shown}.png"), encode_png(drawn))

    def write_maps(self) -> None:
        """Write the tables and matrices."""
        from neurocal_cli.files.exchange.dictionary import npz_bytes

        tree = {}
        for side, remapping in zip(_SIDES, self.remappings, strict=True):
            tree[f"{side}_u"], tree[f"{side}_v"] = remapping.tables()
        matrices = self.pair.matrices
        tree |= {key: getattr(matrices, key) for key in ("R1", "R2", "P1", "P2", "Q")}
        self._write("maps.npz", npz_bytes(tree))

    def _tell(self, text: str) -> None:
        if not self.as_json:
            say(text)

    def _write(self, name: str, content: str | bytes) -> None:
        place = os.path.join(self.output, name)
        make_folder(os.path.dirname(place))
        write_whole(place, content)

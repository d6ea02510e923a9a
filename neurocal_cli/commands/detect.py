"""``neurocal detect``: images in, points out."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import click

from neurocal_cli.commands import boards, options, preparation
from neurocal_cli.commands.boards import (
    board_in_images,
    check_size,
    compare_markers,
    complain_of,
    described_board,
    with_other_kind,
)
from neurocal_cli.commands.frames import STORED, detections, of_one_size, videos_as_frames, watch_for_images
from neurocal_cli.commands.streams import (
    ProgressBar,
    debugging,
    first_of,
    note,
    note_once,
    one_line,
    suggest,
    summarise,
    warn,
    where_reasons_are,
)
from neurocal_cli.errors import NeurocalError, UsageError
from neurocal_cli.files.image_files import find_images, stated_sizes, view_names
from neurocal_cli.files.writing import make_folder, write_whole

if TYPE_CHECKING:
    from neurocal_cli.detection.batch import DetectionOptions, Outcome
    from neurocal_cli.detection.measuring import Points
    from neurocal_cli.observations.board import Board

_ENOUGH = 3  # images that have arrived
_SECOND = 2  # images of another size that are no longer a single stray one


@click.command(cls=options.Command)
@options.argument(
    "images",
    "IMAGE...",
    "Images of one camera (PNG, JPEG, TIFF, BMP, PGM or PPM, of 8 or 16 bits), folders of "
    "images, file name patterns, or videos; - is standard input.",
    nargs=-1,
    required=True,
)
@boards.board("Unit of --square. A board file names its own unit.")
@options.choice(
    "--points",
    "midpoints edges vertices",
    "Points to measure: midpoints of the edges between inner vertices; edges, which adds those of the "
    "edges to the board's rim, for stiff boards with whole outer squares; or the inner vertices.",
    default="midpoints",
)
@options.number(
    "--gamma",
    "G",
    "Gamma of the images, 2.2 for many cameras. The points are slightly more accurate if it is given.",
    without="unknown",
    positive=True,
)
@options.path("--overlay", "DIR", "Draw the detected points over each image and write it to DIR/VIEW.png.")
@options.count(
    "--jobs", "N", "Number of processes that examine images at the same time.", without="the number of cores"
)
@options.count(
    "--frames",
    "N",
    "Maximum number of frames to take from a video: sharp ones that differ from each other.",
    default=50,
)
@options.path(
    "--cache",
    "DIR",
    "Cache the detections in this folder, so that an interrupted run continues where it stopped. The same "
    "image is recognised under any name.",
)
@options.number(
    "--watch",
    "SECONDS",
    "Wait for more images in the folders and patterns. Stop when no image has arrived for this time, or at "
    "Ctrl-C. After each image, report the verdict so far and the view that would help most.",
    without="no",
    positive=True,
)
@options.path(
    "--board-name",
    "NAME",
    "Name of this board, where images show several boards: it becomes a column board. Detect each board by "
    "itself, and calibrate with the files of all of them.",
)
@options.path("--save-board", "BOARD.yaml", "Write the board, as it was described or found, to this file.")
@options.summary
@options.output("POINTS.csv", "Write the points to this file.")
def detect(
    images: tuple[str, ...],
    board: boards.BoardOptions,
    points: str,
    gamma: float | None,
    overlay: str | None,
    jobs: int | None,
    frames: int,
    cache: str | None,
    watch: float | None,
    board_name: str | None,
    save_board: str | None,
    as_json: bool,
    output: str,
) -> None:
    """Detect boards in images and measure points on them.

    The board is found if it is not described: a chessboard, a ChArUco board, an AprilGrid or circles, and
    its numbers of columns and rows; at least some images must show the whole board then. Give the side of a
    square or tag, or the distance of circles, by --square; without it, that is the unit of all lengths. Each
    image becomes a view with the name of its file. A chessboard that is partly hidden or cut off by the image
    is used if enough of its outer border is visible to tell which part it is.

    Boards with markers (ChArUco, AprilGrid) are found by these, and any part with two of them is used. The
    dictionary of a ChArUco board, and whether it has OpenCV's legacy pattern, are told from the image if they
    are not given. Vertices and mid-points are measured as on chessboards; on tags they are their corners
    TAG:0 to TAG:3 and the mid-points of their edges TAG:e0 to TAG:e3. Of tags without the small squares at
    their corners, described by --board, the mid-points of the edges are measured.

    Of a grid of circles, the images of the circles' centres are measured, which are not the centres of the
    ellipses. Some circles may be hidden, but the board's ends must be seen. --points does not matter there.

    A point has the same id in all images. Vertex 0:0 is the corner where OpenCV's
    findChessboardCorners begins; the inner square there is dark. If the numbers of columns and rows
    are both even or both odd, the board looks the same after a turn of 180 degrees, and a warning
    says so.

    The command writes the points as CSV, each with its covariance. A mid-point is measured only in
    the direction (nu,nv) across its edge. If the board is flat, the outermost ones are measured along
    their edges too, and have the direction (0,0). Images in which no board is detected are listed on
    standard error with the reason.

    A video (mp4, avi, mov, mkv and other formats that OpenCV decodes) is reduced to frames that are sharp and
    differ from each other; each becomes a view VIDEO_NUMBER.

    \b
    Examples:
      neurocal sample sample_data
      neurocal detect sample_data/board*.png --square 25 -o points.csv
      neurocal detect sample_data/board*.png --save-board found.yaml -o points.csv
      neurocal detect sample_data/board*.png --cols 9 --rows 6 --square 25 \\
          --unit mm -o points.csv
      neurocal detect sample_data/board*.png --cols 9 --rows 6 --square 25 \\
          --points vertices --gamma 1 --jobs 2 --overlay overlays \\
          | neurocal calibrate - -o camera.yaml
      echo "planes: [{name: board, cols: 9, rows: 6, square: 25}]" > board.yaml
      neurocal detect sample_data/board*.png --board board.yaml --json \\
          --cache found --frames 30 --board-name left -o points.csv
      neurocal detect "sample_data/board*.png" --square 25 --watch 2 -o points.csv
      neurocal board --board charuco:8x6:28:21 --dpi 100 -o print.png
      neurocal detect print.png --board charuco:8x6:28:21 -o points.csv
      neurocal detect print.png --board charuco:8x6:28:21 --board-name A -o a.csv
    """  # noqa: D301 - as in the group
    from neurocal_cli.observations.separate_boards import check_board_name, of_one_board

    if board_name is not None:
        check_board_name(board_name)
    preparation.check_one_stdin(*images, board.file)
    preparation.check_summary(as_json, output)
    if watch is not None:
        options.note_unused("with --watch, which waits for single images", "jobs", "frames")
    if cache is not None:
        preparation.check_folder("--cache", cache)
    described, enough = described_board(board), 1 if watch is None else _ENOUGH
    wanted = _Request(described, board, cast("Points", points), gamma, overlay is not None, cache, enough)
    outputs = (output, save_board)
    if watch is None:
        outcomes = _examined(images, wanted, outputs, overlay, jobs, frames)
    else:
        outcomes = _watched(images, wanted, outputs, watch)
    outcomes, target = of_one_size(outcomes), wanted.board
    assert target is not None
    _report(outcomes, target, as_json)
    from neurocal_cli.files.board_yaml import board_line, format_board
    from neurocal_cli.files.points_csv import format_points
    from neurocal_cli.observations.points import Correspondences

    if save_board is not None:
        write_whole(save_board, format_board(target))
    told = target.unit, target.distances, board_line(target) if board_name is None else ""
    found = Correspondences.from_detections(detections(outcomes), *told)
    if board_name is not None:
        found = of_one_board(found, board_name)
    text = format_points(found)
    if overlay is not None:
        make_folder(overlay)
        for name, outcome in outcomes.items():
            if outcome.overlay is not None:
                write_whole(os.path.join(overlay, f"{name}.png"), outcome.overlay)
    if not preparation.is_for_the_eye(output):
        write_whole(output, text)
    suggest(output, "neurocal calibrate {} -o camera.yaml")


@dataclass
class _Request:
    """What is asked for; the board may have to be found first."""

    board: Board | None
    described: boards.BoardOptions
    points: Points
    gamma: float | None
    overlay: bool
    cache: str | None
    enough: int  # images from which a board can be found if its ends are not seen
    compared: bool = False  # whether the board was compared with images

    def options(self, paths: Sequence[str]) -> DetectionOptions:
        """The options for detection in these images, in which the board's size is found if it is not known.

        Raises NoBoardError if it cannot be found.
        """
        from neurocal_cli.detection.batch import DetectionCache, DetectionOptions
        from neurocal_cli.files.board_yaml import format_board

        if self.board is None:
            self.board = board_in_images(paths, self.described, self.enough)
        elif not self.compared:
            compare_markers(paths, self.board)
        self.compared = True
        known = None
        if self.cache is not None:
            request = f"{self.points} {self.gamma!r} {self.overlay} {format_board(self.board)}"
            known = DetectionCache(self.cache, request)
        return DetectionOptions(self.board, self.points, self.gamma, self.overlay, debugging(), known)


def _examined(
    words: tuple[str, ...],
    wanted: _Request,
    outputs: tuple[str | None, ...],
    overlay: str | None,
    jobs: int | None,
    frames: int,
) -> dict[str, Outcome]:
    """Outcomes of all images, by the names of their views."""
    from neurocal_cli.detection.batch import default_jobs, detect_files

    given = find_images(words)
    view_names(given)  # no name twice
    preparation.check_outputs(outputs, (*given, wanted.described.file))
    with videos_as_frames(given, frames) as (paths, folder):
        names = view_names(paths)
        sizes = Counter(size for size in stated_sizes(paths) if size is not None)
        if len(sizes) > 1 and sizes.most_common(2)[1][1] >= _SECOND:
            counts = ", ".join(f"{count} of {w} x {h} px" for (w, h), count in sizes.most_common(4))
            note(f"the images have {len(sizes)} sizes ({counts}); those of one camera have one")
        if overlay is not None:
            preparation.check_folder("--overlay", overlay)
            folders = {os.path.dirname(os.path.realpath(path)) for path in paths if path != "-"}
            if os.path.realpath(overlay) in folders:
                raise UsageError(f"--overlay {overlay} is the folder of the images; give another folder")
        outcomes, prepared = [], wanted.options(paths)
        with ProgressBar() as progress:
            for outcome in detect_files(paths, prepared, jobs or default_jobs(len(paths))):
                outcomes.append(outcome)
                progress(f"{len(outcomes)} of {len(paths)} images", len(outcomes) / len(paths))
        outcomes = [
            replace(outcome, problem=outcome.problem.removeprefix(folder))
            for outcome in with_other_kind(outcomes, prepared.board)
        ]
    return dict(zip(names, outcomes, strict=True))


def _watched(
    words: tuple[str, ...], wanted: _Request, outputs: tuple[str | None, ...], seconds: float
) -> dict[str, Outcome]:
    """Outcomes of the images that have arrived, by the names of their views."""
    if "-" in words:
        raise UsageError("--watch needs folders or patterns; standard input has one image")
    preparation.check_outputs(outputs, (wanted.described.file,))
    outcomes = watch_for_images(lambda: find_images(words), wanted.options, seconds)
    if not outcomes:
        raise NeurocalError(f"no image came within {seconds:g} seconds; give the folder that they come to")
    preparation.check_outputs(outputs, outcomes)
    return dict(zip(view_names(outcomes), outcomes.values(), strict=True))


def _report(outcomes: Mapping[str, Outcome], board: Board, as_json: bool) -> None:
    """Report failed images with the reason, and remarks common to several images once."""
    found = detections(outcomes)
    problems = {name: outcome.problem for name, outcome in outcomes.items() if outcome.problem}
    complain_of(outcomes.values(), board)
    note_once((name, text) for name, outcome in outcomes.items() for text in outcome.notes)
    warn(*dict.fromkeys(text for detection in found.values() for text in detection.warnings))
    turns = Counter(outcome.turned or "as stored" for outcome in outcomes.values())
    if len(turns) > 1:  # each way of turning has its own image centre
        counts = ", ".join(f"{count} {turn}" for turn, count in turns.most_common())
        warn(
            f"the images have different EXIF orientations ({counts}), so their image centres differ although "
            f"they may be of one camera; {STORED}, and detect again"
        )
    check_size(outcomes.values(), board)
    if not found and len(outcomes) == 1:
        raise NeurocalError(*problems.values())
    if not found:
        raise NeurocalError(f"none of the {len(outcomes)} images shows the board; {where_reasons_are()}")
    summary: dict[str, Any] = {
        "n_images": len(outcomes),
        "n_points": sum(len(detection.ids) for detection in found.values()),
        "n_rejected": sum(detection.rejected for detection in found.values()),
        "views": {name: len(detection.ids) for name, detection in found.items()},
        "without_board": {name: one_line(problem) for name, problem in problems.items()},
    }
    unread = [outcome.path for outcome in outcomes.values() if outcome.unread]
    summarise(
        as_json,
        summary,
        f"board detected in {len(found)} of {len(outcomes)} images: {summary['n_points']} points, "
        f"{summary['n_rejected']} rejected" + (f"; {first_of(unread)} could not be read" if unread else ""),
    )

"""The board of a command: its options, and the board that images show, found or compared with them."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from math import gcd
from typing import TYPE_CHECKING

import click

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.commands import options
from neurocal_cli.commands.options import F
from neurocal_cli.commands.streams import ProgressBar, complain, note, say, warn
from neurocal_cli.errors import InputError, NeurocalError, UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from neurocal_cli.detection.batch import Outcome
    from neurocal_cli.observations.board import Board

Size = tuple[int, int]

_UNKNOWN = "the {} is not given, so it is the unit of all lengths; give it by --square"

_SELDOM = 0.2  # ratio of images with the described size to those with another; boards are seen in mirrors
_COMPARED = 3  # images, with a described board with markers
_PICTURES = (".pdf", ".svg", ".png", ".jpg", ".jpeg")
_USUAL_SIDES = 1.0, 2000.0  # mm, of squares
_OFF_SPACING = 0.05  # of the distance of tags, which images tell to a few thousandths
_FEW = 3  # images; fewer may by chance show the same part of the board


@frozen_dataclass
class BoardOptions:
    """The values of the options of a board, whose file is not read yet."""

    file: str | None
    cols: int | None
    rows: int | None
    square: float | None
    unit: str | None

    def read(self) -> Board | None:
        """The board; None if no option describes one, a UsageError if they contradict each other."""
        self.check_unit()
        size = {"--cols": self.cols, "--rows": self.rows, "--square": self.square}
        missing = [name for name, value in size.items() if value is None]
        if self.file is not None:
            if len(missing) < len(size) or (self.unit is not None and self.is_file):
                raise UsageError(
                    "--board gives the size and the unit; leave out --cols, --rows, --square and --unit"
                )
            return named_board(self.file, self.unit or "mm")
        if len(missing) == len(size) and self.unit is None:
            return None
        if missing:
            raise UsageError(
                f"{' and '.join(missing)} missing; give --cols, --rows and --square, or --board BOARD.yaml"
            )
        return self.read_or_unknown()

    def read_or_unknown(self) -> Board | None:
        """The board, for a command that finds its size itself: None without a size; the square may lack."""
        from neurocal_cli.observations.board import Board

        if self.file is not None:
            return self.read()
        counts, side = self.counts, self.side
        return Board.single(*counts, *side) if counts else None

    @property
    def counts(self) -> tuple[int, int] | tuple[()]:
        """Columns and rows; none if neither is given."""
        if self.cols is not None and self.rows is not None:
            return self.cols, self.rows
        if self.cols is None and self.rows is None:
            return ()
        missing = "--rows" if self.rows is None else "--cols"
        raise UsageError(f"{missing} is missing; give both --cols and --rows, or neither")

    @property
    def side(self) -> tuple[float, str]:
        """Side of a square and its unit; if the side is unknown, it is the unit."""
        self.check_unit()
        if self.square is not None:
            return self.square, self.unit or "mm"
        if self.unit is not None:
            raise UsageError("--unit is the unit of --square, which is missing; give both")
        return 1.0, "squares"

    def note_odd_side(self) -> None:
        """Note a square that is so small or large that its unit may be another one."""
        from neurocal_cli.observations.printed_sheet import millimetres

        if self.square is None:
            return
        with suppress(InputError):  # a unit that is no known length
            side, unit = self.side
            if not _USUAL_SIDES[0] <= side * millimetres(unit) <= _USUAL_SIDES[1]:
                note(f"the squares are {side:g} {unit} wide, as given; if they are not, add their --unit")

    @property
    def is_file(self) -> bool:
        """Whether the board is described by a file, not in short."""
        from neurocal_cli.files.board_kinds import KINDS

        return self.file is not None and self.file.partition(":")[0] not in KINDS

    def check_unit(self) -> None:
        """Refuse a unit that cannot be stored in a file, with a UsageError."""
        unit = self.unit
        if unit is not None and (unit == "" or unit != unit.strip(" \t,;") or not unit.isprintable()):
            raise UsageError(f"--unit is {unit!r}, which cannot be written; name it in a word, such as mm")


_BOARD_FILE = (
    "Board file, of neurocal, Kalibr, OpenCV, PhotonVision or caliscope, the name of calib.io's PDF, or a "
    "board in short: chessboard:COLSxROWS:SQUARE, aprilgrid:COLSxROWS:TAG:SPACING[:FAMILY], "
    "charuco:COLSxROWS:SQUARE:MARKER[:DICTIONARY], arucogrid:COLSxROWS:MARKER:SPACING:DICTIONARY, "
    "circles:COLSxROWS:DISTANCE[:DIAMETER] (asymmetric_circles alike). COLS and ROWS count squares, tags or "
    "circles; of a chessboard, inner vertices."
)


board_of_corners = options.path(
    "--board",
    "BOARD.yaml",
    f"Board of corners whose file does not have their places, such as mrcal's. {_BOARD_FILE}",
)
"""For points of other programs without their places, a command's keyword ``board``."""


def named_board(name: str, unit: str = "mm") -> Board:
    """The board of ``--board``: a short form with lengths in this unit, or a file."""
    from neurocal_cli.files.board_kinds import short_board
    from neurocal_cli.files.board_yaml import read_board

    if (short := short_board(name, unit)) is not None:
        return short
    stem, ending = os.path.splitext(name)
    if ending.lower() in _PICTURES:
        raise UsageError(f"--board {name} is a picture; give the board file, such as {stem}.yaml")
    if re.fullmatch(r"\d+x\d+(:[\d.]+)?", name) and not os.path.exists(name):
        size, _, side = name.partition(":")
        raise UsageError(f"--board {name}: give --board chessboard:{size}:{side or 'SQUARE'}")
    return read_board(name)


def board(unit_help: str, unit_default: str = "mm") -> Callable[[F], F]:
    """Add the options of `BoardOptions`, a command's keyword ``board``."""
    size = partial(options.count, without="none", least=2, most=1000)
    added = (
        options.path("--board", "BOARD.yaml", _BOARD_FILE, to="file"),
        size("--cols", "C", "Number of inner vertices in a row of the board."),
        size("--rows", "R", "Number of rows of inner vertices."),
        options.number(
            "--square",
            "S",
            "Side length of a square, or of a tag, or the distance of circles.",
            without="none",
            positive=True,
        ),
        click.option("--unit", metavar="UNIT", show_default=unit_default, help=unit_help),
    )
    return options.collected(BoardOptions, added, "board")


def described_board(given: BoardOptions) -> Board | None:
    """The described board in its measured size; None if its size is to be found."""
    board = given.read_or_unknown()
    given.note_odd_side()
    if board is not None and given.file is None and given.square is None:
        note(_UNKNOWN.format("side of a square"))
    if board is None or not board.distances:
        return board
    scale = board.scale
    said = f"; {scale.contradiction}" if scale.contradiction else ""
    note(
        f"the measured distances make the board {scale.factor:.6g} times as large as its squares, std "
        f"{100 * scale.std:.2g} %{said}"
    )
    return board.as_measured()


def board_in_images(paths: Sequence[str], given: BoardOptions, enough: int) -> Board:
    """Find the board in image files, and say what it is; see `find_board`.

    Unless an image shows all ends of the board, it is a NoBoardError to have less than `enough` images.
    """
    from neurocal_cli.detection.board_kind import found_board
    from neurocal_cli.detection.placement import NoBoardError
    from neurocal_cli.observations.board import Board
    from neurocal_cli.observations.board_kinds import CirclePlane, found_words, unit_length

    with ProgressBar() as progress:
        found = found_board(_readable(_spread(paths), progress))
    plane = found.plane
    if not found.sure and len(paths) < enough:
        raise NoBoardError(
            "it is not certain where the board ends; more images of the whole board are needed"
        )
    (side, unit), length = given.side, unit_length(plane)
    say(f"found {found_words(plane)}")
    warn(*found.doubts)
    if not found.sure:
        sides, more = "on all sides", f"than {plane.cols} x {plane.rows} circles, describe it by --board"
        if plane.markers is not None:
            sides, more = "at its first and last row", "rows, describe it by --board"
        elif not isinstance(plane, CirclePlane):
            more = f"than {plane.cols} x {plane.rows} inner vertices, give their numbers by --cols and --rows"
        warn(f"no image shows that the board ends {sides}; if it has more {more}")
    if given.square is None:
        note(_UNKNOWN.format(length))
        unit = {"side of a square": "squares", "side of a tag": "tags"}.get(length, "distances")
    return Board((plane.rescaled(side),), unit)


def compare_markers(paths: Sequence[str], board: Board) -> None:
    """Compare a described board of one plane with markers with what some of the images show.

    It is a NeurocalError if they show other columns, whose markers would be called wrongly, another spacing
    of tags or another kind; of more or fewer rows, a warning.
    """
    from neurocal_cli.detection.markers.found import agreed_markers, seen_markers
    from neurocal_cli.detection.placement import NoBoardError
    from neurocal_cli.observations.board_kinds import TagPlane, found_words

    plane = board.planes[0]
    if plane.markers is None or len(board.planes) > 1:
        return
    images = _readable(_spread(paths)[:_COMPARED], lambda text, share: None)
    try:
        seen = [marks for image in images if (marks := seen_markers(image))]
        found = agreed_markers(seen) if seen else None
    except NeurocalError:  # they do not tell the board, or cannot be read, which detection says
        return
    # Of several boards with different numbers, another one may be seen best.
    own = None if found is None else found.plane.markers
    if found is None or own is None or own.first_id != plane.markers.first_id:
        return
    shown = found.plane
    told = f"the images show {found_words(shown)}; the board was described otherwise"
    other = isinstance(shown, TagPlane) != isinstance(plane, TagPlane) or shown.cols != plane.cols
    if isinstance(shown, TagPlane) and isinstance(plane, TagPlane):
        other |= abs(shown.spacing - plane.spacing) > _OFF_SPACING * (1 + shown.spacing)
    if other:
        raise NoBoardError(f"{told}: correct its description, or leave it out")
    if found.sure and shown.rows != plane.rows:
        warn(f"{told}: it has another number of rows")


def with_other_kind(outcomes: list[Outcome], board: Board) -> list[Outcome]:
    """The outcomes; if none has the board, and images show another kind, that is their problem."""
    from neurocal_cli.detection.board_kind import other_kind

    paths = [outcome.path for outcome in outcomes if not outcome.unread]
    if any(outcome.detection is not None for outcome in outcomes) or not paths:
        return outcomes
    with suppress(NeurocalError):  # standard input is read once
        images = _readable(_spread(paths)[:_COMPARED], lambda text, share: None)
        if told := other_kind(images, board.planes[0]):
            name = "{}: {}".format
            return [one if one.unread else replace(one, problem=name(one.path, told)) for one in outcomes]
    return outcomes


def _spread(paths: Sequence[str]) -> list[str]:
    """The same paths, so ordered that the first ones are spread over all: neighbours may be alike."""
    step = next(k for k in range(round(0.38 * len(paths)) or 1, len(paths) + 2) if gcd(k, len(paths)) == 1)
    return [paths[k * step % len(paths)] for k in range(len(paths))]


def _readable(paths: Sequence[str], progress: Callable[[str, float], None]) -> Iterator[NDArray[np.generic]]:
    """The grey images of files, without those that cannot be read, unless no file can be."""
    from neurocal_cli.files.images import read_image

    problem, read = None, False
    for number, path in enumerate(paths):
        progress("finding the board", number / len(paths))
        try:
            grey = read_image(path).grey
        except NeurocalError as error:
            problem = problem or error
            continue
        read = True
        yield grey
    if problem is not None and not read:
        raise problem


def check_size(outcomes: Collection[Outcome], board: Board) -> None:
    """Compare the size of a described board with what most images show, and warn if it differs.

    Another board may fit as a part of the described one, and its points would have wrong coordinates. So it
    is a NeurocalError if hardly an image shows the described size.
    """
    shown = [_shown(outcome) for outcome in outcomes]
    size = another_size(shown, board)
    if size is None:
        return
    given = (board.planes[0].cols, board.planes[0].rows)
    seen, asked = ("{} x {}".format(*each) for each in (size, given))
    told = f"most images show {seen} inner vertices, and {asked} were asked for"
    found = any(outcome.detection is not None for outcome in outcomes)
    if found and len(shown) >= _FEW and shown.count(given) < _SELDOM * shown.count(size):
        raise NeurocalError(
            f"{told}; give --cols {size[0]} --rows {size[1]}, the numbers of inner vertices, not squares"
        )
    warn(f"{told}; count inner vertices, not squares")


def another_size(shown: Sequence[Size | None], board: Board) -> Size | None:
    """Another size than that of a board of one plane, if most images show it; often squares were counted."""
    from neurocal_cli.files.board_kinds import kind_of

    (size, count), *_ = Counter(shown).most_common(1)
    plane = board.planes[0]
    if kind_of(plane) != "chessboard":
        return None  # its parts are told apart by the markers, or it is of circles
    given = size == (plane.cols, plane.rows)
    if given or 2 * count <= len(shown) or len(shown) < 2 or len(board.planes) > 1:
        return None
    return size


def _shown(outcome: Outcome) -> Size | None:
    """Columns and rows of inner vertices that an image shows of a board of one plane."""
    if outcome.detection is None:
        return outcome.shown
    ids = [label.rpartition("/")[2].split(":") for label in outcome.detection.ids]
    columns = {one[-2] for one in ids if one[0] != "h"}
    rows = {one[-1] for one in ids if one[0] != "v"}
    return len(columns), len(rows)


def complain_of(outcomes: Collection[Outcome], board: Board) -> None:
    """Report why images were left out, a line each, and once a remedy that several have in common."""
    problems = [outcome.problem for outcome in outcomes if outcome.problem]
    parts = [problem.partition("; ") for problem in problems]
    remedies = Counter(remedy for _, _, remedy in parts)
    for problem, (reason, _, remedy) in zip(problems, parts, strict=True) if len(outcomes) > 1 else ():
        complain(problem if remedies[remedy] == 1 else reason)
    if another_size([_shown(outcome) for outcome in outcomes], board) is not None:
        return
    remedy, count = max(remedies.items(), key=lambda item: item[1], default=("", 0))
    if remedy and count > 1:
        complain(f"{count} of these {len(problems)} images: {remedy}")

"""The board of ``neurocal detect``: described by the user, or found in the images, and compared with them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from math import gcd
from typing import TYPE_CHECKING

from neurocal_cli.commands.options import BoardOptions
from neurocal_cli.commands.streams import ProgressBar, complain, note, say, warn
from neurocal_cli.errors import NeurocalError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from neurocal_cli.detection.batch import Outcome
    from neurocal_cli.observations.board import Board

Size = tuple[int, int]

_UNKNOWN = "the {} is not given, so it is the unit of all lengths; give it by --square"

_SELDOM = 0.2  # ratio of images with the described size to those with another; boards are seen in mirrors
_COMPARED = 3  # images, with a described board with markers
_FEW = 3  # images; fewer may by chance show the same part of the board


def described_board(options: BoardOptions) -> Board | None:
    """The described board in its measured size; None if its size is to be found."""
    board = options.read_or_unknown()
    if board is not None and options.file is None and options.square is None:
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


def board_in_images(paths: Sequence[str], options: BoardOptions, enough: int) -> Board:
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
    (side, unit), length = options.side, unit_length(plane)
    say(f"found {found_words(plane)}")
    warn(*found.doubts)
    if not found.sure:
        sides, more = "on all sides", f"than {plane.cols} x {plane.rows} circles, describe it by --board"
        if plane.markers is not None:
            sides, more = "at its first and last row", "rows, describe it by --board"
        elif not isinstance(plane, CirclePlane):
            more = f"than {plane.cols} x {plane.rows} inner vertices, give their numbers by --cols and --rows"
        warn(f"no image shows that the board ends {sides}; if it has more {more}")
    if options.square is None:
        note(_UNKNOWN.format(length))
        unit = (
            "squares"
            if length == "side of a square"
            else "tags"
            if length == "side of a tag"
            else "distances"
        )
    return Board((plane.rescaled(side),), unit)


def compare_markers(paths: Sequence[str], board: Board) -> None:
    """Compare a described board of one plane with markers with what some of the images show.

    It is a NeurocalError if they show other columns, whose markers would be called wrongly, or another kind;
    of more or fewer rows, a warning.
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
    shown = None if found is None else found.plane
    # Of several boards with different numbers, another one may be seen best.
    if (
        found is None
        or shown is None
        or shown.markers is None
        or (shown.markers.first_id != plane.markers.first_id)
    ):
        return
    told = f"the images show {found_words(shown)}; the board was described otherwise"
    if isinstance(shown, TagPlane) != isinstance(plane, TagPlane) or shown.cols != plane.cols:
        raise NoBoardError(f"{told}: correct its description, or leave it out")
    if found.sure and shown.rows != plane.rows:
        warn(f"{told}: it has another number of rows")


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

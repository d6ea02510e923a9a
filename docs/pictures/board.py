"""A board to print: 10 x 7 squares of 25 mm, 9 x 6 inner vertices, on A4."""

from __future__ import annotations

from style import HERE

from neurocal_cli import Board
from neurocal_cli.files.board_pictures import board_svg
from neurocal_cli.observations.printed_sheet import PAPERS, on_paper


def main() -> None:
    sheet = on_paper(Board.single(9, 6, 25.0), PAPERS["A4"])
    (HERE / "board-9x6-25mm.svg").write_text(board_svg(sheet), encoding="utf-8")


if __name__ == "__main__":
    main()

"""A board to print: 10 x 7 squares of 25 mm, 9 x 6 inner vertices, on A4; and six good views of it."""

from __future__ import annotations

from style import HERE, SAMPLES, figure, save

from neurocal_cli import Board, read_image
from neurocal_cli.files.board_pictures import board_svg
from neurocal_cli.observations.printed_sheet import PAPERS, on_paper


def main() -> None:
    sheet = on_paper(Board.single(9, 6, 25.0), PAPERS["A4"])
    (HERE / "board-9x6-25mm.svg").write_text(board_svg(sheet), encoding="utf-8")
    made = figure(3.1)
    for number, axes in enumerate(made.subplots(2, 3).ravel(), start=1):
        image = read_image(str(SAMPLES / f"board{number:02d}.png")).grey
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
        axes.set_axis_off()
    made.get_layout_engine().set(w_pad=0.06, h_pad=0.06)
    save(made, "views.png", dpi=110)


if __name__ == "__main__":
    main()

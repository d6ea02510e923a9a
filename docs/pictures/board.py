"""A board to print: 10 x 7 squares of 25 mm, 9 x 6 inner vertices, on A4; and six good views of it."""

from __future__ import annotations

from style import HERE, SAMPLES, figure, save

from neurocal_cli import read_image

COLS, ROWS, SQUARE = 9, 6, 25.0


def main() -> None:
    (HERE / "board-9x6-25mm.svg").write_text(_board(), encoding="utf-8")
    made = figure(3.1)
    for number, axes in enumerate(made.subplots(2, 3).ravel(), start=1):
        image = read_image(str(SAMPLES / f"board{number:02d}.png")).grey
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
        axes.set_axis_off()
    made.get_layout_engine().set(w_pad=0.06, h_pad=0.06)
    save(made, "views.png", dpi=110)


def _board() -> str:
    """The drawing, in millimetres: a printer at 100 % makes squares of 25 mm."""
    left, top = (297 - (COLS + 1) * SQUARE) / 2, (210 - (ROWS + 1) * SQUARE) / 2
    squares = [
        f'<rect x="{left + c * SQUARE:g}" y="{top + r * SQUARE:g}" width="{SQUARE:g}" height="{SQUARE:g}"/>'
        for r in range(ROWS + 1)
        for c in range(COLS + 1)
        if (r + c) % 2 == 0
    ]
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" width="297mm" height="210mm" viewBox="0 0 297 210">\n'
        '<rect width="297" height="210" fill="white"/>\n' + "\n".join(squares) + "\n</svg>\n"
    )


if __name__ == "__main__":
    main()

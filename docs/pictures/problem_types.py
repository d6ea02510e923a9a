"""Which weights are given and which are learnt in each of the four problem types."""

from __future__ import annotations

from matplotlib.patches import Rectangle
from style import BLUE, GREY, INK, ORANGE, PALE, PALE_BLUE, PALE_ORANGE, drawing, save

A = (("$\\alpha_u$", "s", "$u_0$"), ("0", "$\\alpha_v'$", "$v_0$"), ("0", "0", "1"))
SIZE = 0.285


def main() -> None:
    made, axes = drawing(4.5)
    titles = (
        "type 1: nothing is given",
        "type 2: the image centre",
        "type 3: the intrinsics",
        "type 4: the poses",
    )
    for number, title in enumerate(titles, start=1):
        left, top = 0.3 + 2.7 * ((number - 1) % 2), 4.2 - 1.95 * ((number - 1) // 2)
        axes.text(left, top - 0.08, title, weight="bold")
        axes.text(left + 1.5 * SIZE, top - 0.42, "W", ha="center", color=ORANGE)
        axes.text(left + 1.12 + 2 * SIZE, top - 0.42, "V", ha="center", color=BLUE)
        for row in range(3):
            for column in range(3):
                fixed = A[row][column] in "01" or number == 3 or (number == 2 and column == 2)
                _cell(axes, left, top - 0.55, row, column, A[row][column], fixed, PALE_ORANGE)
            for column in range(4):
                name = f"$t_{'xyz'[row]}$" if column == 3 else f"$r_{{{row + 1}{column + 1}}}$"
                _cell(axes, left + 1.12, top - 0.55, row, column, name, number == 4, PALE_BLUE)
    for place, fill, text in (
        (0.3, PALE_ORANGE, ""),
        (0.52, PALE_BLUE, "learnt from random values"),
        (3.0, PALE, "given"),
    ):
        axes.add_patch(Rectangle((place, 0.22), 0.18, 0.18, facecolor=fill, edgecolor=GREY, linewidth=0.7))
        axes.text(place + 0.28, 0.31, text, va="center")
    save(made, "problem-types.svg")


def _cell(axes, left: float, top: float, row: int, column: int, name: str, given: bool, fill: str) -> None:
    corner = (left + column * SIZE, top - (row + 1) * SIZE)
    colour = PALE if given else fill
    axes.add_patch(Rectangle(corner, SIZE, SIZE, facecolor=colour, edgecolor=GREY, linewidth=0.7))
    axes.text(
        corner[0] + SIZE / 2,
        corner[1] + SIZE / 2,
        name,
        ha="center",
        va="center",
        fontsize=8.5,
        color=GREY if given else INK,
    )


if __name__ == "__main__":
    main()

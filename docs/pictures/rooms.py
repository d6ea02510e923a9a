"""The nine rooms of the package, and which of them imports which, read from the code."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

from matplotlib.patches import Arc, FancyBboxPatch, Rectangle
from style import BLUE, GREY, INK, PALE_BLUE, PALE_GREEN, PALE_ORANGE, drawing, save

import neurocal_cli

PACKAGE = Path(neurocal_cli.__file__).parent
# From the top down, with the colour of what a room is about: people and files, cameras, mathematics.
ROOMS = {
    "commands": PALE_ORANGE,
    "detection": PALE_ORANGE,
    "simulation": PALE_ORANGE,
    "files": PALE_ORANGE,
    "calibration": PALE_BLUE,
    "network": PALE_BLUE,
    "adjustment": PALE_BLUE,
    "observations": PALE_GREEN,
    "camera": PALE_GREEN,
}
LEFT, WIDE, HIGH, STEP = 0.3, 3.0, 0.42, 0.56


def imports() -> Counter[tuple[str, str]]:
    """Number of modules of a room that each of a module's room imports."""
    found: Counter[tuple[str, str]] = Counter()
    for room in ROOMS:
        for path in (PACKAGE / room).rglob("*.py"):
            nodes = [n for n in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(n, ast.ImportFrom)]
            used = {
                n.module.split(".")[1] for n in nodes if n.module and n.module.startswith("neurocal_cli.")
            }
            found.update((room, other) for other in used & ROOMS.keys() - {room})
    return found


def lines(room: str) -> int:
    return sum(len(path.read_text("utf-8").splitlines()) for path in (PACKAGE / room).rglob("*.py"))


def main() -> None:
    top = 0.3 + STEP * (len(ROOMS) - 1)
    made, axes = drawing(top + 0.75)
    place = {room: top - STEP * n for n, room in enumerate(ROOMS)}
    most = max(map(lines, ROOMS))
    for room, colour in ROOMS.items():
        y, share = place[room], lines(room) / most
        inside = sorted(path.parent.name for path in (PACKAGE / room).glob("*/__init__.py"))
        box = {"boxstyle": "round,pad=0,rounding_size=0.06", "linewidth": 1.0}
        axes.add_patch(FancyBboxPatch((LEFT, y), WIDE, HIGH, facecolor=colour, edgecolor=INK, **box))
        axes.add_patch(Rectangle((LEFT + 0.06, y + 0.04), 0.05, (HIGH - 0.08) * share, facecolor=GREY))
        axes.text(LEFT + 0.2, y + HIGH / 2, room, va="center", weight="bold")
        text = "\n".join(", ".join(inside[n : n + 3]) for n in range(0, len(inside), 3))
        axes.text(LEFT + WIDE - 0.1, y + HIGH / 2, text, va="center", ha="right", color=GREY, fontsize=7)
    for (room, other), count in imports().items():
        low, high = place[other] + 0.3, place[room] + 0.12
        span = {"width": 0.8 * (high - low) + 0.2, "height": high - low, "theta1": -90, "theta2": 90}
        axes.add_patch(
            Arc((LEFT + WIDE, (low + high) / 2), **span, color=BLUE, alpha=0.6, linewidth=0.4 + count / 25)
        )
    axes.text(LEFT, 0.1, "an arc: the upper room imports the lower one", color=BLUE, fontsize=8, va="center")
    axes.text(LEFT + WIDE, 0.1, "bars: lines of code", color=GREY, fontsize=8, va="center", ha="left")
    save(made, "rooms.svg")


if __name__ == "__main__":
    main()

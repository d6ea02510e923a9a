"""Write the table of wrong inputs from what becomes of them now.

Run ``python docs/tools/wrong_inputs_table.py`` and commit the result; a test compares the words.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reference" / "wrong-inputs.md"
_ROW = re.compile(r"^\| ([^|]+?) \| (refused|poor|usable|good) \|", flags=re.MULTILINE)


def words() -> dict[str, str]:
    """What becomes of each wrong input, as the page has it."""
    return dict(_ROW.findall(PAGE.read_text(encoding="utf-8")))


def _reason(text: str) -> str:
    """The reason without the view and without what to do about it."""
    return re.sub(r"^view '\w+'( \(and \d+ more views\))?: ", "", text.partition("; ")[0]).replace("|", "/")


def main() -> None:
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    from support.wrong_inputs import FLAT, FOLDED, outcome

    text = PAGE.read_text(encoding="utf-8")
    made = []
    for name in [*FLAT, *FOLDED]:
        found = outcome(name)
        made.append(f"| {name} | {found.word} | {_reason(found.named or found.reasons[0])} |\n")
    head = "| wrong input | ends | because |\n| --- | --- | --- |\n"
    PAGE.write_text(text[: text.index(head)] + head + "".join(made), encoding="utf-8")


if __name__ == "__main__":
    main()

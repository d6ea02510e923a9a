"""Write the tables of wrong inputs and of wrong rigs from what becomes of them now.

Run ``python docs/tools/wrong_inputs_table.py`` and commit the result; a test compares the words.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reference" / "wrong-inputs.md"
RIGS = ROOT / "docs" / "reference" / "wrong-rigs.md"
_ROW = re.compile(r"^\| ([^|]+?) \| (refused|poor|usable|good) \|", flags=re.MULTILINE)


def words(page: Path = PAGE) -> dict[str, str]:
    """What becomes of each wrong input, as the page has it."""
    return dict(_ROW.findall(page.read_text(encoding="utf-8")))


def _reason(text: str) -> str:
    """The reason without the view and without what to do about it."""
    return re.sub(r"^view '\w+'( \(and \d+ more views\))?: ", "", text.partition("; ")[0]).replace("|", "/")


def main() -> None:
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    from support import wrong_inputs, wrong_rigs

    found = {name: wrong_inputs.outcome(name) for name in [*wrong_inputs.FLAT, *wrong_inputs.FOLDED]}
    _write(PAGE, {name: (one.word, one.named or one.reasons[0]) for name, one in found.items()})
    rigs = {name: wrong_rigs.outcome(name) for name in wrong_rigs.WRONG}
    _write(RIGS, {name: (rig.word, rig.reasons[0]) for name, rig in rigs.items()})


def _write(page: Path, outcomes: dict[str, tuple[str, str]]) -> None:
    text = page.read_text(encoding="utf-8")
    made = [f"| {name} | {word} | {_reason(reason)} |\n" for name, (word, reason) in outcomes.items()]
    text = re.sub(r"^(Each of the )\d+ rows", rf"\g<1>{len(made)} rows", text, flags=re.MULTILINE)
    head = "| wrong input | ends | because |\n| --- | --- | --- |\n"
    page.write_text(text[: text.index(head)] + head + "".join(made), encoding="utf-8")


if __name__ == "__main__":
    main()

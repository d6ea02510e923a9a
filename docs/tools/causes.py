"""Write the table of rival causes from the list of them.

Run ``python docs/tools/causes.py`` and commit the result; a test compares the table.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reference" / "causes.md"
HEAD = "| cause | what the data look like | shared by | advice |\n| --- | --- | --- | --- |\n"


def table() -> str:
    """One row for each cause of a camera, of its rows, of a rig, of matches and of a zoom lens."""
    sys.path[:0] = [str(ROOT)]
    from neurocal_cli.calibration.rig import causes, match_mistakes
    from neurocal_cli.calibration.verdict import effects
    from neurocal_cli.calibration.verdict.mistakes import MISTAKES
    from neurocal_cli.calibration.verdict.rivals import ANOTHER_LENS, RIVALS
    from neurocal_cli.calibration.zoom import judgement

    shared = {
        effects.common: "all views",
        effects.one_view: "one view",
        effects.changing: "all views in a pattern, or a group",
        effects.grouped: "a group of views",
        None: "no views: each has its own",
    }
    rows = [(one, shared[one.patterns]) for one in (*RIVALS, ANOTHER_LENS)]
    rows += [(one, "one view, or all") for one in MISTAKES]
    rows += [(one, f"{'all cameras' if one.of_all else 'a camera'} of a rig") for one in causes.CAUSES]
    rows.append((causes.MIXED_UNITS, "all cameras of a rig"))
    rows += [(one, "all matches") for one in match_mistakes.MISTAKES]
    rows += [(one, f"{'one setting' if one.of_one else 'all settings'}") for one in judgement.CAUSES]
    told = dict.fromkeys(f"| {one.cause} | {one.looks} | {who} | {one.advice} |\n" for one, who in rows)
    return HEAD + "".join(told)


def main() -> None:
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text[: text.index(HEAD)] + table(), encoding="utf-8")


if __name__ == "__main__":
    main()

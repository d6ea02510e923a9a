"""What the reports share: numbers and names as text, aligned tables, and the verdict.

Values are rounded by their standard deviation: it keeps two significant digits, and the value has the same
number of decimals, so that no meaningless digit is shown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import field
from typing import TYPE_CHECKING, Any

from neurocal_cli.calibration.verdict.findings import two_digits
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES
from neurocal_cli.commands.streams import print_summary, print_text, table_width, verbose

if TYPE_CHECKING:
    from neurocal_cli.calibration.calibration import Calibration, Verdict
    from neurocal_cli.calibration.rig.rig import Rig

Table = list[list[str]]
"""Rows of cells, the heading first."""

UNITS = dict.fromkeys(INTRINSIC_NAMES, "px") | {"theta": "rad"}
"""Of the intrinsic parameters; the coefficients of the distortion have none."""

_MOST_TOLD = 3  # reasons, and pieces of advice, that a reader takes in
_MOST_VIEWS = 20  # rows of a table that fit on a screen
_MOST_DECIMALS = 9  # further digits are rounding errors
# The main measures of a verdict, in words.
_FACTS: dict[str, Callable[[float], str]] = {
    "held_out_px": "cross-validation error {:.3g} px".format,
    "precision_px": "noise floor {:.3g} px".format,
    "projection_px": lambda std: (
        f"std of predicted pixels {two_digits(std)} px at most at the views' distance"
    ),
    "depth_share": lambda std: f"std of triangulated depth {100 * std:.2g} % of the depth",
    "coverage": lambda share: f"{100 * share:.0f} % of the image covered",
}


def joined(*blocks: Sequence[str]) -> str:
    """Blocks of lines with an empty line between them, without blocks that have no lines."""
    return "\n\n".join("\n".join(block) for block in blocks if block)


@frozen_dataclass(eq=False)
class Report:
    """What a command answers: the values for JSON, and the same as tables with lines above and below."""

    tree: Mapping[str, Any] = field(default_factory=dict)
    tables: Sequence[Table] = ()
    below: Sequence[str] = ()
    above: Sequence[str] = ()
    titles: Sequence[str] = ()  # of the tables, or none

    def text(self) -> str:
        """The tables and lines."""
        titles = [[title] if title else [] for title in self.titles] or [[]] * len(self.tables)
        blocks = [[*title, *align(rows)] for title, rows in zip(titles, self.tables, strict=True)]
        return joined(self.above, *blocks, self.below)

    def print(self, as_json: bool) -> None:
        """Print it on stdout: as JSON, or as text for its width if it is a terminal."""
        if as_json:
            print_summary(self.tree)
        else:
            print_text(self.text)

    def __or__(self, other: Report) -> Report:
        """Both in one, tables before lines."""
        return Report({**self.tree, **other.tree}, [*self.tables, *other.tables], [*self.below, *other.below])


def align(rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table: the first column to the left, the others to the right.

    On a terminal that is too narrow, the columns that do not fit stand below, after the first one again.
    """
    rows = list(rows)
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines: list[str] = []
    for shown in _fitting(widths):
        lines += [""] if lines else []
        lines += [
            "  ".join(
                row[k].ljust(widths[k]) if k == 0 else row[k].rjust(widths[k]) for k in (0, *shown)
            ).rstrip()
            for row in rows
        ]
    return lines


def _fitting(widths: Sequence[int]) -> list[list[int]]:
    """Columns of each table that fit beside the first one, in as few tables as possible."""
    most, room = table_width(), 0
    parts: list[list[int]] = [[]]
    for k in range(1, len(widths)):
        room += 2 + widths[k]
        if most is not None and parts[-1] and widths[0] + room > most:
            parts.append([])
            room = 2 + widths[k]
        parts[-1].append(k)
    return parts


def align_views(heading: list[str], rows: Sequence[tuple[float, list[str]]], what: str) -> list[str]:
    """Lines of a table of views, or what else `what` says, each row with its error; none for a single row.

    They are in the order of the data; if there are too many, only those with the largest errors are shown.
    """
    if len(rows) == 1:
        return []
    if len(rows) <= _MOST_VIEWS:
        return align([heading, *(cells for _, cells in rows)])
    worst = sorted(rows, key=lambda row: -row[0])[:_MOST_VIEWS]
    below = f"the {_MOST_VIEWS} {what} with the largest error, of {len(rows)} {what}"
    return [*align([heading, *(cells for _, cells in worst)]), below]


def rounded(value: float, std: float) -> tuple[str, str]:
    """Format a value and its standard deviation, both to the deviation's second significant digit.

    Examples
    --------
    >>> rounded(556.01234, 0.4321)
    ('556.01', '0.43')
    >>> rounded(5560.1, 432.1)
    ('5560', '430')
    """
    if not (math.isfinite(value) and math.isfinite(std)) or std <= 0:
        return f"{value:.7g}", "unknown" if not math.isfinite(std) else "0"
    decimals = 1 - int(f"{std:.1e}".partition("e")[2])
    if decimals > _MOST_DECIMALS:
        return f"{value:.{_MOST_DECIMALS}f}", f"{std:.1e}"
    places = max(decimals, 0)
    # + 0.0 avoids -0
    return f"{round(value, decimals) + 0.0:.{places}f}", f"{round(std, decimals):.{places}f}"


def with_std(value: float, std: float) -> str:
    """A value with its standard deviation; see `rounded`."""
    return " +- ".join(rounded(value, std))


def four_digits(value: float) -> str:
    """A number with four significant digits."""
    if not math.isfinite(value):
        return "-"
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.3e}"
    return f"{value:#.4g}".rstrip(".")


def number(value: float, form: str) -> str:
    """The number in a format such as ``.3g``, or a dash if it is not finite."""
    return format(value, form) if math.isfinite(value) else "-"


def round_down(scale: float) -> float:
    """Round down to one of 1, 2, 5, 10, ...; 1 if there is none."""
    if not math.isfinite(scale) or scale <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(scale))
    return power * max(step for step in (1.0, 2.0, 5.0) if step <= scale / power * (1 + 1e-9))


def labelled(name: str, unit: str) -> str:
    """A quantity with its unit, if it has one."""
    return f"{name} [{unit}]" if unit else name


def parameters(calibration: Calibration) -> dict[str, float]:
    """The intrinsic parameters and the coefficients of the distortion."""
    names = (*INTRINSIC_NAMES, *coefficient_names(calibration.distortion_model))
    values = [*calibration.intrinsics.values().tolist(), *calibration.distortion.tolist()]
    return dict(zip(names, values, strict=True))


def estimates(calibration: Calibration, given: str = "fixed") -> dict[str, tuple[str, str]]:
    """The same as text, with the standard deviations, or with this word where the value was given."""
    return {
        name: (f"{value:.7g}", given)
        if name in calibration.fixed
        else rounded(value, calibration.std.get(name, math.nan))
        for name, value in parameters(calibration).items()
    }


def parameters_json(calibration: Calibration) -> dict[str, dict[str, Any]]:
    """The same for JSON, with the standard deviations."""
    return {
        name: {
            "value": value,
            "std": calibration.std.get(name, math.nan),
            "fixed": name in calibration.fixed,
        }
        for name, value in parameters(calibration).items()
    }


def attributes(value: Any, names: str) -> dict[str, Any]:
    """Attributes of an object for JSON, by their own names or, of ``name=attribute``, by others."""
    words = (word.rpartition("=") for word in names.split())
    return {name or own: getattr(value, own) for name, _, own in words}


def outcome_json(result: Calibration | Rig) -> dict[str, Any]:
    """How the estimation of a result ended, for JSON."""
    ending = {"stop_reason": str.__str__(result.stop_reason), "warnings": result.warnings}
    return {"converged": result.converged, **ending, **verdict_json(result.verdict)}


def verdict_lines(verdict: Verdict | None) -> list[str]:
    """Lines of a verdict: the word, the main measures, and the most important reasons and advice.

    With ``neurocal -v``, all of them.
    """
    if verdict is None:
        return []
    found = facts(verdict)
    lines = [f"verdict: {verdict.word}", *([f"  {found}"] if found else [])]
    told = {"reason": verdict.reasons, "advice": verdict.advice}
    most = None if verbose() else _MOST_TOLD
    lines += [f"  {kind}: {text}" for kind, texts in told.items() for text in texts[:most]]
    hidden = 0 if most is None else sum(max(len(texts) - most, 0) for texts in told.values())
    return [*lines, f"  {hidden} more of less weight: `neurocal -v` shows them"] if hidden else lines


def verdict_json(verdict: Verdict | None) -> dict[str, Any]:
    """The entry `verdict` of a summary, empty without a verdict; measures that are not finite become None."""
    return {} if verdict is None else {"verdict": attributes(verdict, "word reasons advice measures")}


def facts(verdict: Verdict) -> str:
    """The main measures of a verdict in one line."""
    m = verdict.measures
    return ", ".join(text(m[name]) for name, text in _FACTS.items() if math.isfinite(m.get(name, math.nan)))

"""The page about a fleet: what was done, histograms of the parameters, and a table of all cameras."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

import numpy as np

from neurocal_cli.calibration.fleet import fleet_sigmas
from neurocal_cli.camera.geometry import Array
from neurocal_cli.commands.batch_rows import Row, drift_text, of_one_kind
from neurocal_cli.commands.show.html_page import figure, page, section
from neurocal_cli.commands.show.text import printable

_MOST_ROWS = 5000  # a browser sorts them at once
_BINS = 24
_WITHIN = 8.0  # fleet sigmas that a histogram shows
_DRAWN = {"alpha_u": "px", "alpha_v": "px", "u0": "px", "v0": "px", "rmse_px": "px", "held_out_px": "px"}
_FEWEST = 5  # cameras for a histogram
_WIDTH, _HEIGHT, _FOOT = 320.0, 130.0, 24.0
_WORDS = ("good", "usable", "poor")

# Columns of the table: heading, key and format. Those that no row has are left out.
_COLUMNS = (
    ("verdict", "verdict", ""), ("drift", "drift", ""), ("drift rms [px]", "drift_px", "#.2g"),
    ("its std [px]", "drift_std_px", "#.2g"), ("alpha_u [px]", "alpha_u", ".2f"),
    ("its std [px]", "alpha_u_std", "#.2g"), ("alpha_v [px]", "alpha_v", ".2f"), ("u0 [px]", "u0", ".2f"),
    ("v0 [px]", "v0", ".2f"), ("baseline", "baseline", ".6g"), ("distortion model", "distortion", ""),
    ("rms [px]", "rmse_px", "#.3g"), ("cross-validation error [px]", "held_out_px", "#.3g"),
    ("views", "n_views", ""), ("points", "n_points", ""), ("outliers", "n_rejected", ""),
    ("time [s]", "seconds", "#.2g"),
)  # fmt: skip


def fleet_page(rows: Sequence[Row], name: str) -> str:
    """Make the page of the rows of a summary; it stands beside the folders of the jobs, to which it links."""
    status = Counter(row["status"] for row in {row["name"]: row for row in rows}.values())
    verdicts = Counter(row["verdict"] for row in rows if row.get("verdict"))
    head = f"{sum(status.values())} jobs: {_counted(status)}"
    judged = ", ".join(f"{verdicts[word]} {word}" for word in _WORDS if verdicts[word])
    parts = [f'<p class="soft">{escape(head)}{f"; cameras: {judged}" if judged else ""}</p>']
    parts += [
        section("Changed since the earlier batch", _list(rows, drift_text)),
        section("Far from the fleet", _list(rows, lambda row: row.get("outlier", ""))),
        section("Failed", _list({row["name"]: row for row in rows}.values(), lambda row: row["problem"])),
        section("The fleet", *_histograms(rows)),
        section("Cameras", _table(rows)),
    ]
    return page(f"Fleet {printable(name)}", [part for part in parts if part])


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {word}" for word, count in counts.items())


def _list(rows: Iterable[Row], text: Callable[[Row], str]) -> str:
    """The rows that have a text."""
    lines = [f"<li>{_link(row)}: {escape(said)}</li>" for row in rows if (said := text(row))]
    return f"<ul>{''.join(lines[:_MOST_ROWS])}</ul>" if lines else ""


def _link(row: Row) -> str:
    """The name of a row, which leads to its report, or to its log if there is none."""
    file = "report.html" if row.get("file") else "log.txt"
    label = escape(printable(f"{row['name']} {row['camera']}".strip()))
    if not row.get("log"):
        return label
    return f'<a href="{quote(str(row["name"]))}/{file}">{label}</a>'


def _table(rows: Sequence[Row]) -> str:
    columns = [column for column in _COLUMNS if any(row.get(column[1]) not in (None, "") for row in rows)]
    head = "".join(f"<th>{escape(title)}</th>" for title, _, _ in [("camera", "", ""), *columns])
    lines = []
    for row in rows[:_MOST_ROWS]:
        cells = "".join(f"<td>{_cell(row.get(key), form)}" for _, key, form in columns)
        marked = row.get("outlier") or drift_text(row) or row["status"] != "done"
        lines.append(f"<tr{' class=mark' if marked else ''}><td>{_link(row)}{cells}")
    style = "<style>tr.mark{background:var(--card)}tr.mark a{color:var(--poor)}a{color:var(--accent)}</style>"
    more = len(rows) - _MOST_ROWS
    below = f'<p class="soft">{more} more are in summary.csv</p>' if more > 0 else ""
    content = f"<thead><tr>{head}</tr></thead>\n<tbody>" + "\n".join(lines)
    return f'{style}<div class="wide"><table class="sort">{content}</tbody></table></div>{below}'


def _cell(value: Any, form: str) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return escape(format(value, form).rstrip(".") if form else str(value))


def _histograms(rows: Sequence[Row]) -> list[str]:
    """Histograms of the parameters, for each kind of camera."""
    figures, kinds = [], of_one_kind(rows)
    for (name, size), alike in kinds.items():
        of = f" of {size} px" if len({size for _, size in kinds}) > 1 else ""
        for key, unit in _DRAWN.items():
            values = np.array([row[key] for row in alike if row.get(key) is not None], dtype=float)
            if len(values) >= _FEWEST and np.ptp(values) > 0:
                figures.append(_histogram(values, f"{name} {key}".strip() + of, unit))
    return [f'<div class="figures">{"".join(figures)}</div>'] if figures else []


def _histogram(values: Array, label: str, unit: str) -> str:
    sigmas = np.abs(fleet_sigmas(values, np.zeros(len(values))))
    near = values[sigmas <= _WITHIN]
    if not len(near) or np.ptp(near) == 0:
        near = values
    counts, edges = np.histogram(near, bins=_BINS)
    each, tallest = _WIDTH / _BINS, max(int(counts.max()), 1)
    bars = "".join(
        f'<rect x="{k * each + 0.5:.1f}" y="{_HEIGHT * (1 - count / tallest):.1f}" width="{each - 1:.1f}" '
        f'height="{_HEIGHT * count / tallest:.1f}" class="bar"><title>{edges[k]:.6g} to {edges[k + 1]:.6g}: '
        f"{count}</title></rect>"
        for k, count in enumerate(counts.tolist())
    )
    low, high = f"{edges[0]:.5g}", f"{edges[-1]:.5g}"
    texts = (
        f'<text x="0" y="{_HEIGHT + 15}" font-size="11">{low}</text>'
        f'<text x="{_WIDTH}" y="{_HEIGHT + 15}" font-size="11" text-anchor="end">{high}</text>'
    )
    drawing = (
        f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT + _FOOT:.0f}" role="img" '
        f'aria-label="histogram of {escape(label)}">'
        f'<path d="M0 {_HEIGHT}H{_WIDTH}" class="axis" style="stroke-width:1"/>{bars}{texts}</svg>'
    )
    beyond = len(values) - len(near)
    caption = f"{label} [{unit}]: median {np.median(values):.6g}, {len(values)} cameras"
    return figure(drawing, caption + (f"; {beyond} lie beyond the drawing" if beyond else ""))

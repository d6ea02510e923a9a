"""Elements of a page: style, script, tables, the verdict, the origin, and drawings as SVG.

Colours come from the style of the page, so they suit its light and dark modes. The levels of a map differ
by equal factors, because the corners of an image can be a hundred times as uncertain as its middle. Each
level is one path of rectangles, so a map takes only some kilobytes.
"""

from __future__ import annotations

import platform
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field
from functools import cache
from html import escape
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from numpy.typing import NDArray

from neurocal_cli import __version__
from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.commands.show.text import facts, round_down

_LONG = 40  # characters; longer cells are texts
_STYLE = """
:root{color-scheme:light dark;--ink:#1c2330;--soft:#5b6472;--paper:#fff;--card:#f4f6f9;
--edge:#d5dae2;--accent:#2b5fb3;--line:#c8401f;--good:#1d7a3c;--usable:#8a6100;--poor:#b3261e}
@media (prefers-color-scheme:dark){:root{--ink:#e6e9ef;--soft:#9aa4b2;--paper:#14171c;--card:#1d222a;
--edge:#363d49;--accent:#8ab4f8;--line:#ff8a65;--good:#6fcf8b;--usable:#e6b450;--poor:#ff8a80}}
*{box-sizing:border-box}
body{margin:0 auto;max-width:1100px;padding:1.2rem;background:var(--paper);color:var(--ink);
font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
h1{font-size:1.6rem;margin:.2rem 0}
h2{font-size:1.2rem;margin:2rem 0 .6rem;border-bottom:1px solid var(--edge)}
p,li{max-width:75ch}.soft{color:var(--soft)}
.verdict{border-left:.5rem solid var(--edge);background:var(--card);padding:.8rem 1rem;margin:1rem 0}
.verdict b{font-size:1.3rem}.good{border-color:var(--good)}.good b{color:var(--good)}
.usable{border-color:var(--usable)}.usable b{color:var(--usable)}
.poor{border-color:var(--poor)}.poor b{color:var(--poor)}
.wide{overflow-x:auto}.wide+.wide{margin-top:1rem}table{border-collapse:collapse;font-variant-numeric:tabular-nums}
th,td{padding:.25rem .8rem .25rem 0;text-align:right;vertical-align:top;white-space:nowrap;
border-bottom:1px solid var(--edge)}.text{text-align:left}td.text{white-space:normal;min-width:12rem}
th:first-child,td:first-child{text-align:left}
th button{all:unset;cursor:pointer;text-decoration:underline dotted}th button:focus-visible{outline:2px solid}
.figures{display:grid;gap:1rem;grid-template-columns:repeat(auto-fill,minmax(min(100%,380px),1fr))}
.views{display:grid;gap:.6rem;grid-template-columns:repeat(auto-fill,minmax(min(100%,170px),1fr))}
.wider{grid-template-columns:repeat(auto-fill,minmax(min(100%,250px),1fr))}
figure{margin:0;break-inside:avoid}figcaption{color:var(--soft);font-size:.85rem;overflow-wrap:anywhere}
svg{display:block;width:100%;height:auto;fill:var(--ink)}.views svg{cursor:zoom-in}
.frame{fill:var(--card);stroke:var(--edge);vector-effect:non-scaling-stroke}
.dots{stroke:var(--accent);stroke-linecap:round;fill:none}.lines{stroke:var(--line);fill:none}
.out{stroke:var(--poor);fill:none}image{opacity:.6}
image~.dots{stroke:#00b7ff}image~.lines,image~.out{stroke:#ff1f4b}
.heat{fill:var(--accent);shape-rendering:crispEdges}.marks{stroke:var(--ink);stroke-linecap:round;fill:none}
.axis{stroke:var(--soft);fill:none}.bar,.up{fill:var(--accent)}.down{fill:var(--line)}
dialog{width:min(96vw,1200px);border:1px solid var(--edge);background:var(--paper);color:var(--ink)}
dialog::backdrop{background:#000a}dl{display:grid;grid-template-columns:auto 1fr;gap:.2rem 1rem}
dt{color:var(--soft)}dd{margin:0;overflow-wrap:anywhere}code{font-size:.9em}
@media (max-width:480px){th,td{white-space:normal}th,td{padding-right:.5rem}
dl{grid-template-columns:1fr}dd{margin-bottom:.5rem}}
@media print{:root{--ink:#000;--paper:#fff;--card:#f4f6f9;--edge:#bbb;--soft:#444;--accent:#2b5fb3}
body{max-width:none;padding:0;font-size:10pt}h2,h2+p{break-after:avoid}tr{break-inside:avoid}
.wide{overflow:visible}.views{grid-template-columns:repeat(4,1fr)}dialog{display:none}}
"""
_SCRIPT = """
for(const table of document.querySelectorAll("table.sort")){
 table.querySelectorAll("th").forEach((head,column)=>{
  const button=document.createElement("button");button.textContent=head.textContent;
  head.textContent="";head.append(button);let up=false;
  button.onclick=()=>{up=!up;const rows=[...table.tBodies[0].rows];
   const key=row=>row.cells[column].textContent.trim();
   rows.sort((a,b)=>{const x=key(a),y=key(b),n=parseFloat(x)-parseFloat(y);
    return (up?1:-1)*((column>0&&!isNaN(n))?n:x.localeCompare(y,undefined,{numeric:true}))});
   table.tBodies[0].append(...rows);table.querySelectorAll("th").forEach(h=>h.removeAttribute("aria-sort"));
   head.setAttribute("aria-sort",up?"ascending":"descending")}})}
const large=document.querySelector("dialog");
for(const figure of document.querySelectorAll(".views figure")){
 figure.onclick=()=>{large.replaceChildren(figure.cloneNode(true));large.showModal()}}
large.onclick=()=>large.close();
"""
_MOST = 4000  # greatest number of vectors in a drawing
_MOST_DOTS = 1500  # on a map
_LONGEST = 0.04  # length of a residual of three times the rms, as a share of the image's width
_CELLS = 120  # approximate number of cells of a map across
_LEVELS = 8
_FAINTEST, _STRONGEST = 0.06, 0.92  # opacity
_LARGEST = 0.45  # radius of the largest deviation of a board, as a share of the points' spacing


def page(title: str, parts: Iterable[str]) -> str:
    """Make a whole page of a title and HTML parts in order."""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width,initial-scale=1">\n'
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none';img-src data:;style-src 'unsafe-inline';script-src 'unsafe-inline'\">\n"
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style></head>\n<body>\n<h1>{escape(title)}</h1>\n"
        + "\n".join(parts)
        + f'\n<p class="soft">neurocal {__version__}</p>\n<dialog></dialog>\n'
        f"<script>{_SCRIPT}</script>\n</body></html>\n"
    )


def section(title: str, *parts: str) -> str:
    """Make a section with a heading; empty if it has no content."""
    content = "\n".join(part for part in parts if part)
    return f"<h2>{escape(title)}</h2>\n{content}" if content else ""


def table(rows: Sequence[Sequence[str]], sortable: bool = False) -> str:
    """Make a table of rows, the first of which are the headings; empty without others."""
    head, *body = rows
    if not body:
        return ""
    sort = ' class="sort"' if sortable else ""
    texts = [any(len(row[k]) > _LONG for row in body) for k in range(len(head))]
    cells = "".join(
        f"<th{' class=text' * text}>{escape(cell)}</th>" for cell, text in zip(head, texts, strict=True)
    )
    marks = ("", " class=text")  # of texts that are long and may wrap
    written = ((f"<td{marks[len(cell) > _LONG]}>{escape(cell)}</td>" for cell in row) for row in body)
    lines = "\n".join(f"<tr>{''.join(row)}</tr>" for row in written)
    content = f"<thead><tr>{cells}</tr></thead>\n<tbody>{lines}</tbody>"
    return f'<div class="wide"><table{sort}>{content}</table></div>'


def figure(drawing: str, caption: str) -> str:
    """Make a figure with a caption; empty without a drawing."""
    return f"<figure>{drawing}<figcaption>{escape(caption)}</figcaption></figure>" if drawing else ""


def verdict_block(verdict: Verdict | None) -> str:
    """Show the word of the verdict, its measures, reasons and advice."""
    if verdict is None:
        return '<div class="verdict">no verdict, because the file has no points</div>'
    lists = ""
    for title, entries in (("Reasons", verdict.reasons), ("Advice", verdict.advice)):
        if entries:
            lists += f"<p>{title}</p><ul>{''.join(f'<li>{escape(entry)}</li>' for entry in entries)}</ul>"
    word = escape(verdict.word)  # files may come from untrusted sources
    return f'<div class="verdict {word}"><b>{word}</b> <span>{escape(facts(verdict))}</span>{lists}</div>'


@frozen_dataclass
class Origin:
    """The run that produced a result, as far as known."""

    files: Mapping[str, str]  # SHA-256 of the input files, or of the result's own if the run is unknown
    command: str | None = None  # the command line
    versions: Mapping[str, str] = field(default_factory=dict)  # of the programs that computed the result


@cache
def versions() -> dict[str, str]:
    """Versions of the running programs."""
    found = {"neurocal": __version__, "Python": platform.python_version()}
    for name in ("numpy", "scipy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # not installed as a package
            continue
    return found


def residual_map(
    pixels: Array,
    residuals: Array,
    size: tuple[int, int],
    scale: float | None = None,
    bold: float = 1.0,
    *,
    left_out: Array | None = None,
    photograph: bytes | None = None,
) -> str:
    """Draw residuals (N, 2) [px] as enlarged lines from their pixels, also over a JPEG photograph.

    `scale` is the enlargement of the residuals; by default their `enlargement`. `bold` is a factor on the
    thickness of lines, for small drawings. Points `left_out` (M, 2) become crosses.
    """
    width, height = size
    scale = enlargement(residuals, size) if scale is None else scale
    step = -(-len(pixels) // _MOST)
    ends = pixels[::step] + scale * residuals[::step]
    path = "".join(
        f"M{u:.1f} {v:.1f}L{x:.1f} {y:.1f}" for (u, v), (x, y) in zip(pixels[::step], ends, strict=True)
    )
    dots = "".join(f"M{u:.1f} {v:.1f}h0" for u, v in pixels[::step])
    arm, crosses = width / 100, ""
    if left_out is not None and len(left_out):
        arms = "".join(
            f"M{u - arm:.1f} {v - arm:.1f}L{u + arm:.1f} {v + arm:.1f}"
            f"M{u - arm:.1f} {v + arm:.1f}L{u + arm:.1f} {v - arm:.1f}"
            for u, v in left_out
        )
        crosses = f'<path d="{arms}" class="out" stroke-width="{width / 300:.2f}"/>'
    image = "" if photograph is None else b64encode(photograph).decode()
    if image:  # its pixel centres are at whole numbers
        place = f'x="-.5" y="-.5" width="{width}" height="{height}"'
        image = f'<image {place} href="data:image/jpeg;base64,{image}"/>'
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="residuals, {scale:.3g} times enlarged">'
        f'<rect width="{width}" height="{height}" class="frame"/>{image}'
        f'<path d="{dots}" class="dots" stroke-width="{bold * width / 240:.2f}"/>'
        f'<path d="{path}" class="lines" stroke-width="{bold * width / 450:.2f}"/>'
        f"{crosses}</svg>"
    )


def enlargement(residuals: Array, size: tuple[int, int]) -> float:
    """Round factor that makes residuals (N, 2) [px] visible in an image of a size [px]."""
    rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))) if len(residuals) else 0.0
    if not rms > 0:
        return 1.0
    return round_down(_LONGEST * size[0] / (3 * rms))


def scatter(residuals: Array) -> str:
    """Draw residuals (N, 2) [px] as points, with a circle of their rms, as in the pictures of ``--plot``."""
    sigma = float(np.sqrt(np.mean(residuals**2))) if len(residuals) else 0.0
    if not sigma > 0:
        return ""
    step = -(-len(residuals) // _MOST)
    shown = np.clip(residuals[::step] / sigma, -5.5, 5.5)
    dots = "".join(f"M{x:.2f} {y:.2f}h0" for x, y in shown)
    return (
        '<svg viewBox="-6 -6 12 12" role="img" aria-label="du and dv of all points">'
        '<rect x="-6" y="-6" width="12" height="12" class="frame"/>'
        f'<path d="{dots}" class="dots" stroke-width="0.11"/>'
        '<path d="M-6 0H6M0 -6V6" class="axis" stroke-width="0.02"/>'
        f'<circle r="{np.sqrt(2):.3f}" class="lines" stroke-width="0.07"/>'
        f'<text x="-5.8" y="-5.3" font-size="0.5">circle: rms {np.sqrt(2) * sigma:.2g} px</text>'
        '<text x="5.8" y="0.6" font-size="0.5" text-anchor="end">du</text>'
        '<text x="0.2" y="5.8" font-size="0.5">dv</text></svg>'
    )


def error_bars(names: Sequence[str], errors: Sequence[float], overall: float) -> str:
    """Draw the rms error of each view as a bar, with a line at that of all points, and axes."""
    count = len(names)
    if not count or not max(errors, default=0) > 0:
        return ""
    width, height, left = 640.0, 240.0, 60.0
    least = max(*errors, overall) / 4
    power = 10.0 ** np.floor(np.log10(least))
    step = float(power * min(one for one in (1.0, 2.0, 5.0, 10.0) if one >= least / power))
    most = step * np.ceil(1.02 * max(*errors, overall) / step)
    each = (width - left) / count

    def level(value: float) -> float:
        return height * (1 - value / most)

    bars = "".join(
        f'<rect x="{left + (k + 0.1) * each:.1f}" y="{level(error):.1f}" width="{0.8 * each:.1f}" '
        f'height="{height - level(error):.1f}" class="bar">'
        f"<title>{escape(name)}: {error:.3g} px</title></rect>"
        for k, (name, error) in enumerate(zip(names, errors, strict=True))
    )
    ticks = [step * k for k in range(round(most / step) + 1)]
    numbers = "".join(
        f'<text x="{left - 8:.0f}" y="{level(tick) + 6:.1f}" font-size="17" '
        f'text-anchor="end">{tick:.3g}</text>'
        for tick in ticks
    )
    lines = "".join(f"M{left - 4:.0f} {level(tick):.1f}H{width:.0f}" for tick in ticks)
    numbered = "".join(
        f'<text x="{left + (k + 0.5) * each:.1f}" y="{height + 20:.0f}" font-size="17" '
        f'text-anchor="middle">{k + 1}</text>'
        for k in range(0, count, max(1, -(-count // 12)))
    )
    return (
        f'<svg viewBox="0 -12 {width:.0f} {height + 38:.0f}" role="img" aria-label="rms error of each view">'
        f'<path d="{lines}" class="axis" stroke-width="0.5"/>{bars}{numbers}{numbered}'
        f'<path d="M{left:.0f} {level(overall):.1f}H{width:.0f}" class="lines" stroke-width="2"/></svg>'
    )


def board_shape(across: Array, height: Array) -> str:
    """Draw heights (n,) of points of a plane (n, 2) as discs: the area is the height, the colour its sign."""
    low, high = across.min(axis=0), across.max(axis=0)
    size = np.maximum(high - low, 1e-9 * float((high - low).max()))
    spacing = float(np.sqrt(size.prod() / len(across)))
    largest = float(np.abs(height).max())
    if not largest > 0:
        return ""
    radii = _LARGEST * spacing * np.sqrt(np.abs(height) / largest)
    discs = "".join(
        f'<circle cx="{x:.4g}" cy="{y:.4g}" r="{r:.3g}" class="{"up" if h > 0 else "down"}">'
        f"<title>{h:+.2g}</title></circle>"
        for (x, y), r, h in zip(across - low, radii, height, strict=True)
    )
    x, y = -0.5 * spacing, -0.5 * spacing
    w, h = size + spacing
    return (
        f'<svg viewBox="{x:.4g} {y:.4g} {w:.4g} {h:.4g}" role="img" aria-label="shape of the board">'
        f'<rect x="{x:.4g}" y="{y:.4g}" width="{w:.4g}" height="{h:.4g}" class="frame"/>{discs}</svg>'
    )


def heat_map(values: Array, size: tuple[float, float], dots: Array, unit: str, label: str) -> str:
    """Draw positive values (R, C) on a grid from edge to edge, with interpolation; empty if none is finite.

    nan is unknown, and R and C are at least 2. `size` and the places `dots` (N, 2) to mark have one unit.
    `unit` is that of the values, for the scale below the map, and `label` is for screen readers.
    """
    logarithms = np.log(np.where(values > 0, values, np.nan))
    seen = logarithms[np.isfinite(logarithms)]
    if not seen.size:
        return ""
    cells = _between(logarithms, -(-_CELLS // (values.shape[1] - 1)))
    low, high = float(seen.min()), max(float(seen.max()), float(seen.min()) + 0.01)
    bounds = np.linspace(low, high, _LEVELS + 1)
    level = np.clip(np.digitize(cells, bounds) - 1, 0, _LEVELS - 1)
    level[~np.isfinite(cells)] = -1
    width, height = size
    rows, columns = cells.shape
    texts = [f"{bound:.2g}" for bound in np.exp(bounds)]
    paths = "".join(
        f'<path d="{_rectangles(level == k)}" fill-opacity="{_opacity(k)}">'
        f"<title>{texts[k]} to {texts[k + 1]} {unit}</title></path>"
        for k in range(_LEVELS)
    )
    step = -(-len(dots) // _MOST_DOTS) or 1
    marks = "".join(f"M{x:.4g} {y:.4g}h0" for x, y in dots[::step])
    margin, edge = width / 10, width / 200
    return (
        f'<svg viewBox="{-edge:.3g} {-edge:.3g} {width + 2 * edge:.6g} {height + margin + edge:.6g}" '
        f'role="img" aria-label="{label}">'
        f'<rect width="{width:.6g}" height="{height:.6g}" class="frame"/>'
        f'<g class="heat" transform="scale({width / columns:.6g} {height / rows:.6g})">{paths}</g>'
        f'<path d="{marks}" class="marks" stroke-width="{width / 220:.3g}"/>'
        f"{_scale(texts, unit, width, height, margin)}</svg>"
    )


def _between(values: Array, times: int) -> Array:
    """Interpolate values linearly at the centres of the cells of a finer grid."""
    rows, columns = ((np.arange((count - 1) * times) + 0.5) / times for count in values.shape)
    r, c = rows.astype(int), columns.astype(int)
    down, across = (rows - r)[:, None], columns - c
    upper = values[r][:, c] * (1 - across) + values[r][:, c + 1] * across
    lower = values[r + 1][:, c] * (1 - across) + values[r + 1][:, c + 1] * across
    return np.asarray(upper * (1 - down) + lower * down)


def _rectangles(mask: NDArray[np.bool_]) -> str:
    """Path of the cells of a mask; adjacent cells of a row form one rectangle."""
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(int), axis=1)
    starts, ends = np.argwhere(edges == 1), np.argwhere(edges == -1)
    lengths = ends[:, 1] - starts[:, 1]
    return "".join(
        f"M{column} {row}h{length}v1h-{length}z"
        for (row, column), length in zip(starts.tolist(), lengths.tolist(), strict=True)
    )


def _opacity(level: int) -> str:
    return f"{_FAINTEST + (_STRONGEST - _FAINTEST) * level / (_LEVELS - 1):.2f}"


def _scale(texts: list[str], unit: str, width: float, height: float, margin: float) -> str:
    """Draw the scale of levels below the map, with their bounds."""
    each, font = width / (_LEVELS + 1.5), 0.36 * margin
    parts = ""
    for k, text in enumerate(texts):
        x = k * each
        if k < _LEVELS:
            parts += (
                f'<rect x="{x:.6g}" y="{height + 0.2 * margin:.6g}" width="{each:.6g}" '
                f'height="{0.3 * margin:.3g}" class="heat" fill-opacity="{_opacity(k)}"/>'
            )
        else:
            text = f"{text} {unit}"
        if k % 2 == 0:
            parts += (
                f'<text x="{x:.6g}" y="{height + 0.95 * margin:.6g}" font-size="{font:.3g}">{text}</text>'
            )
    return parts

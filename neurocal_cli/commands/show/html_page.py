"""Elements of a page: its style and script, sortable tables, the verdict and the origin."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field
from functools import cache
from html import escape
from importlib.metadata import PackageNotFoundError, version

from neurocal_cli import __version__
from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.commands.show.text import facts

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


def definitions(entries: Mapping[str, str]) -> str:
    """Make a list of names and descriptions."""
    lines = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in entries.items())
    return f"<dl>{lines}</dl>"


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

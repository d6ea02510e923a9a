"""Run what README.md and docs/ show, and write there what the commands really print.

A page's blocks run in order, in one empty folder that holds ``sample_data`` alone:

* ``sh``: the commands have to succeed;
* ``console``: after each line that begins with ``$``, what the command prints (both streams). A line
  ``...`` stands for lines left out, in the middle or at the end;
* ``python``: the program has to succeed.

A comment ``<!-- not run: why -->`` in the line before a block excepts it. With ``<!-- one program -->`` in a
page, its ``python`` blocks continue each other, and run as one program in the place of the last.

``python docs/tools/consoles.py [PAGE...]`` runs the pages and rewrites what the consoles show.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
_BLOCK = re.compile(r"(?P<before>[^\n]*)\n```(?P<kind>sh|console|python)\n(?P<text>.*?)```", re.DOTALL)
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
# How often something was repeated until it agreed to the last digits differs from processor to processor.
_REPEATS = re.compile(r"\d+(?= (?:\w+ )?(?:iterations?|steps?|starts?)\b)")
_RELATIVE = 2e-3  # two processors differ by less in anything that is printed
_LEFT_OUT = "..."
_ONE_PROGRAM = "<!-- one program -->"


@dataclass(frozen=True)
class Block:
    """A fenced block of a page: its language, its text and where the text is in the page."""

    kind: str
    text: str
    start: int
    end: int


@dataclass(frozen=True)
class Shown:
    """A command of a console and the output that the page shows, with where that is in the page."""

    command: str
    output: str
    start: int
    end: int


def blocks(page: str) -> Iterator[Block]:
    """The blocks of a page's text that are to be run."""
    for match in _BLOCK.finditer("\n" + page):
        setting_up = match["text"].startswith("python3 -m venv")  # the continuous integration runs these two
        if "<!-- not run" not in match["before"] and not setting_up:
            yield Block(match["kind"], match["text"], match.start("text") - 1, match.end("text") - 1)


def joined(page: str) -> list[Block]:
    """The blocks of a page, with those of ``python`` as one where they continue each other."""
    found = list(blocks(page))
    python = [block for block in found if block.kind == "python"]
    if _ONE_PROGRAM not in page or not python:
        return found
    whole = replace(python[-1], text="\n".join(block.text for block in python))
    return [whole if block is python[-1] else block for block in found if block not in python[:-1]]


def commands(block: Block) -> Iterator[Shown]:
    """The commands of a console block and their outputs."""
    for match in re.finditer(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", block.text, flags=re.MULTILINE):
        yield Shown(match[1], match[2], block.start + match.start(2), block.start + match.end(2))


def prepare(folder: Path) -> dict[str, str]:
    """Put the sample data into an empty folder, and return the environment to run commands in."""
    (folder / "sample_data").symlink_to(ROOT / "sample_data")
    tools = folder / ".tools"
    tools.mkdir()
    for name, words in {"neurocal": "-m neurocal_cli ", "python": ""}.items():
        (tools / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {words}"$@"\n')
        (tools / name).chmod(0o755)
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    return os.environ | {
        "PATH": f"{tools}:{os.environ['PATH']}",
        "PYTHONPATH": path,
        "COLUMNS": "80",
        "OPENBLAS_NUM_THREADS": "1",
        "LC_ALL": "C.UTF-8",
    }


def run(words: list[str], folder: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a program in the folder, with both streams in one."""
    return subprocess.run(
        words,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        check=False,
    )


def run_page(text: str, folder: Path) -> Iterator[tuple[Shown, str]]:
    """Run the blocks of a page in the folder.

    Yields
    ------
    shown : Shown
        A command of a console.
    printed : str
        What it printed.

    Raises
    ------
    RuntimeError
        A block ``sh`` or ``python`` failed.
    """
    environment = prepare(folder)
    for block in joined(text):
        if block.kind == "console":
            for shown in commands(block):
                yield shown, run(["sh", "-c", shown.command], folder, environment).stdout
            continue
        program = ["sh", "-euc"] if block.kind == "sh" else [sys.executable, "-c"]
        ended = run([*program, block.text], folder, environment)
        if ended.returncode != 0:
            raise RuntimeError(f"exit status {ended.returncode} of\n{block.text}\n{ended.stdout}")


def agrees(shown: str, printed: str) -> bool:
    """Whether a console shows what a command printed, but for rounding and lines left out."""
    lines = printed.splitlines()
    place = 0
    parts = re.split(rf"^{re.escape(_LEFT_OUT)}\n", shown, flags=re.MULTILINE)
    for number, part in enumerate(parts):
        wanted = part.splitlines()
        last = number == len(parts) - 1
        if not wanted and last:
            break  # the rest is left out
        places = range(place, len(lines) - len(wanted) + 1)
        if number == 0:
            places = places[:1]
        if last:
            places = places[-1:]
        found = [n for n in places if all(map(_same, wanted, lines[n : n + len(wanted)]))]
        if not found:
            return False
        place = found[0] + len(wanted)
    return len(parts) > 1 or place == len(lines)


def _same(shown: str, printed: str) -> bool:
    """Whether two lines are the same but for blanks, and numbers within what processors differ by."""
    shown, printed = _REPEATS.sub("some", shown), _REPEATS.sub("some", printed)
    if _NUMBER.sub("#", shown).split() != _NUMBER.sub("#", printed).split():
        return False
    pairs = zip(_NUMBER.findall(shown), _NUMBER.findall(printed), strict=True)
    return all(_close(a, b) for a, b in pairs)


def _close(a: str, b: str) -> bool:
    """Whether two printed numbers differ by no more than a unit of the last digit, or by little."""
    unit = max(_unit(a), _unit(b))
    return abs(float(a) - float(b)) <= max(_RELATIVE * abs(float(a)), 1.001 * unit)


def _unit(number: str) -> float:
    mantissa, _, exponent = number.partition("e")
    return float(10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2])))


def renewed(shown: str, printed: str) -> str:
    """What a console should show: the output, with as many lines left out as before."""
    lines = [line.rstrip() + "\n" for line in printed.splitlines()]
    head, mark, tail = shown.partition(f"{_LEFT_OUT}\n")
    if not mark:
        return "".join(lines)
    n, m = len(head.splitlines()), len(tail.rpartition(f"{_LEFT_OUT}\n")[2].splitlines())
    return "".join([*lines[:n], mark, *lines[len(lines) - m :]])


def rewrite(page: Path) -> bool:
    """Write into a page what its commands print; whether anything had changed."""
    text = page.read_text(encoding="utf-8")
    new, end = [], 0
    with tempfile.TemporaryDirectory() as folder:
        for shown, printed in run_page(text, Path(folder)):
            kept = agrees(shown.output, printed)
            new += [text[end : shown.start], shown.output if kept else renewed(shown.output, printed)]
            end = shown.end
    changed = "".join([*new, text[end:]])
    if changed != text:
        page.write_text(changed, encoding="utf-8")
    return changed != text


if __name__ == "__main__":
    for path in [Path(name).resolve() for name in sys.argv[1:]] or PAGES:
        if any(blocks(path.read_text(encoding="utf-8"))):
            print(path.relative_to(ROOT), "rewritten" if rewrite(path) else "as it was", flush=True)

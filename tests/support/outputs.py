"""Record what all commands write, and compare it with an earlier record, byte for byte.

Before the code is rearranged, ``python tests/support/outputs.py record BEFORE`` in the project's root; after
each step, the same with another folder, and ``python tests/support/outputs.py compare BEFORE AFTER``. The
commands are those of `outputs.txt` on the sample data, and others on real data beside the project, if any.
``--only WORD`` runs the groups whose names contain the word.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = Path(__file__).with_suffix(".txt")
REAL = ROOT.parent / "shared" / "data"
# Times differ from run to run.
_TIMES = re.compile(rb'"seconds": [0-9.e-]+|\b[0-9.]+ m?s\b|^ *[0-9.]+ s\b', re.MULTILINE)
_ZIPPED = re.compile(r"\.(npz|mat)$")


def groups() -> Iterator[tuple[str, list[str]]]:
    """Names of folders, and the commands to run in each, one after the other."""
    sections = re.split(r"^\[(\w+)\]\n", COMMANDS.read_text("utf-8"), flags=re.MULTILINE)
    for name, lines in zip(sections[1::2], sections[2::2], strict=True):
        yield name, [line for line in lines.splitlines() if line]
    yield "help", [f"{words} --help" for words in _command_names()]
    if REAL.is_dir():
        yield from _real_groups()


def _command_names() -> list[str]:
    names = [path.stem for path in sorted((ROOT / "docs" / "commands").glob("*.md")) if path.stem != "index"]
    return [name.replace("-", " ") if name != "lens" else name for name in names]


def _real_groups() -> Iterator[tuple[str, list[str]]]:
    boards = {
        "opencv_stereo": ("*left*.jpg", "*right*.jpg", "9 --rows 6 --square 25"),
        "sony_chess": ("*.jpg", None, "4 --rows 6 --square 30"),
        "fisheye_ocam": ("*.jpg", None, "8 --rows 6 --square 32.5"),
        "fisheye_stereo": ("left*.jpg", "right*.jpg", "9 --rows 6 --square 24.23"),
    }
    for name, (left, right, board) in boards.items():
        lines = []
        for side, pattern in (("left", left), ("right", right)):
            if pattern and list((REAL / name).glob(pattern)):
                for kind in ("midpoints", "vertices"):
                    points = f"{side}_{kind}"
                    found = f"--points {kind} --jobs 1 -o {points}.csv"
                    lines.append(f"detect data/{name}/{pattern} --cols {board} {found}")
                    lines.append(f"calibrate {points}.csv -o {points}.yaml")
        if right:
            lines.append("stereo left_midpoints.csv right_midpoints.csv -o rig.yaml")
            lines.append("evaluate stereo rig.yaml --json")
        yield name, lines
    for folder in ("field_reports", "wrong_data", "photographs", "zhang_planar", "rig4_points"):
        files = sorted((REAL / folder).glob("*.csv"))
        yield folder, [f"calibrate data/{folder}/{file.name} -o {file.stem}.yaml" for file in files]
        pairs = [file.stem.removesuffix("_l") for file in files if file.stem.endswith("_l")]
        places = [(pair, f"data/{folder}/{pair}") for pair in pairs]
        yield f"{folder}_rigs", [f"stereo {to}_l.csv {to}_r.csv -o {pair}_l.yaml" for pair, to in places]
    lines = []
    for file in sorted((REAL / "other_programs").iterdir()):
        lines.append(f"convert data/other_programs/{file.name} --to neurocal -o {file.name}.yaml")
        lines.append(f"calibrate data/other_programs/{file.name}")
    yield "other_programs", lines
    lines = []
    for file in sorted((REAL / "photographs").iterdir()):
        if file.suffix in (".png", ".jpg"):
            lines.append(f"detect data/photographs/{file.name} --cols 9 --rows 6 --square 1 --jobs 1")
    yield "photographs_detect", lines


def record(folder: Path, only: str) -> None:
    """Run all groups, two at a time."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = [(name, lines) for name, lines in groups() if only in name]
    with ThreadPoolExecutor(2) as pool:
        for name in pool.map(lambda group: _run_group(folder, *group), wanted):
            print(name, flush=True)


def _run_group(folder: Path, name: str, lines: list[str]) -> str:
    place = folder / name
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    (place / "sample_data").symlink_to(ROOT / "sample_data")
    (place / "data").symlink_to(REAL)
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {
        **os.environ,
        "PYTHONPATH": paths,
        "COLUMNS": "100",
        "OPENBLAS_NUM_THREADS": "1",
        "SOURCE_DATE_EPOCH": "0",
    }
    for n, line in enumerate(lines):
        words = [expanded for word in shlex.split(line) for expanded in _expanded(place, word)]
        done = subprocess.run(
            [sys.executable, "-m", "neurocal_cli", *words], cwd=place, env=environment, capture_output=True
        )
        text = b"\n".join(
            [line.encode(), f"exit status {done.returncode}".encode(), done.stdout, b"----", done.stderr]
        )
        (place / f"{n:02}.txt").write_bytes(_TIMES.sub(b"SECONDS", text))
    (place / "sample_data").unlink()
    (place / "data").unlink()
    return name


def _expanded(place: Path, word: str) -> list[str]:
    if "*" not in word:
        return [word]
    return [str(path.relative_to(place)) for path in sorted(place.glob(word))]


def compare(before: Path, after: Path) -> int:
    """List the files of two records that differ or are in one of them only; their number."""
    names = [{str(p.relative_to(f)) for p in f.rglob("*") if p.is_file()} for f in (before, after)]
    wrong = sorted(names[0] ^ names[1])
    for name in sorted(names[0] & names[1]):
        if _content(before / name) != _content(after / name):
            wrong.append(name)
    for name in wrong:
        print(name)
    print(f"{len(names[0] & names[1])} files compared, {len(wrong)} differ")
    return len(wrong)


def _content(file: Path) -> bytes:
    content = file.read_bytes()
    if _ZIPPED.search(file.name):  # these have the time at which they were written
        return content[128:] if file.suffix == ".mat" else b"".join(_members(file))
    return _TIMES.sub(b"SECONDS", content)


def _members(file: Path) -> Iterator[bytes]:
    from zipfile import ZipFile

    with ZipFile(file) as archive:
        for name in archive.namelist():
            yield name.encode() + archive.read(name)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("record", "compare"))
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    if given.what == "record":
        record(given.folders[0].resolve(), given.only)
    else:
        sys.exit(compare(*given.folders) > 0)

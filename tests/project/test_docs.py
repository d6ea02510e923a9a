"""README.md and docs/: what they show runs, is complete and links to something."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from consoles import PAGES, ROOT, agrees, blocks, run_page
from reference import pages

import neurocal_cli

README = (ROOT / "README.md").read_text(encoding="utf-8")
MANY_BLOCKS = [page for page in PAGES if any(blocks(page.read_text(encoding="utf-8")))]


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def test_the_first_two_blocks_are_one_command_each() -> None:
    first, second = re.findall(r"```(\w*)\n(.*?)```", README, flags=re.DOTALL)[:2]
    for language, text in (first, second):
        assert language == "sh"
        assert len(text.splitlines()) == 1
        assert text.startswith("python3 -m venv .venv && .venv/bin/pip install")
    assert "neurocal calibrate sample_data/points.csv --type 2" in first[1]
    assert "pytest" in second[1]


def test_the_readme_is_short_and_shows_a_picture() -> None:
    assert len(README.splitlines()) <= 200
    assert README.index("![") < README.index("```")


# The longest pages. README.md shows the same commands.
SLOW_PAGES = {"docs/tutorial.md", "docs/concepts/target.md"} | {
    f"docs/how-to/{page}.md"
    for page in (
        "bad-calibration",
        "fisheye",
        "images",
        "next-views",
        "opencv",
        "other-programs",
        "pipelines",
        "rectify",
        "report",
        "ros",
        "surveyed-points",
        "undistort",
        "zoom-lens",
    )
}


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name(page), marks=[pytest.mark.slow] * (name(page) in SLOW_PAGES))
        for page in MANY_BLOCKS
    ],
)
def test_what_a_page_shows_runs_and_prints_that(page: Path, tmp_path: Path) -> None:
    for shown, printed in run_page(page.read_text(encoding="utf-8"), tmp_path):
        assert agrees(shown.output, printed), (
            f"$ {shown.command}\n{printed}\n`python docs/tools/consoles.py` rewrites it"
        )


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("rms 0.363 px\n", "rms 0.364 px\n"),
        ("a  1.00\nb 20.0\n", "a 1.00\nb  19.97\n"),
        ("first\n...\n", "first\nsecond\n"),
        ("first\n...\nlast\n", "first\nsecond\nlast\n"),
        ("-0.0000 px\n", "+0.0000 px\n"),
        ("89 iterations, after 3 common steps\n", "100 iterations, after 5 common steps\n"),
        ("", ""),
    ],
)
def test_a_console_may_differ_by_rounding_and_by_lines_left_out(shown: str, printed: str) -> None:
    assert agrees(shown, printed)


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("rms 0.363 px\n", "rms 0.366 px\n"),
        ("first\n", "first\nsecond\n"),
        ("first\n...\nlast\n", "first\nlast\nsecond\n"),
        ("second\n...\n", "first\nsecond\n"),
        ("verdict: good\n", "verdict: poor\n"),
        ("12.0 px\n", "px 12.0\n"),
    ],
)
def test_a_console_may_not_differ_otherwise(shown: str, printed: str) -> None:
    assert not agrees(shown, printed)


def test_the_reference_pages_are_those_of_the_program() -> None:
    committed = {path: (ROOT / "docs" / path).read_text(encoding="utf-8") for path in pages()}
    assert committed == pages(), "run `python docs/tools/reference.py` and commit the result"


def test_each_command_has_a_page_and_is_in_the_menu_and_in_the_readme() -> None:
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    made = {path for path in pages() if path.startswith("commands/")}
    assert made == {name(path)[5:] for path in (ROOT / "docs" / "commands").glob("*.md")}
    for path in made:
        assert f" {path}\n" in menu
    for page in (ROOT / "man").glob("neurocal-*.1"):
        words = page.stem.replace("-", " ")
        assert f"commands/{page.stem.partition('-')[2]}.md" in made
        assert words in README


def test_each_public_name_is_in_the_python_reference() -> None:
    assert set(
        re.findall(r"^::: neurocal_cli\.(\w+)$", pages()["reference/api.md"], flags=re.MULTILINE)
    ) == set(neurocal_cli.__all__)


def prose(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as Python-Markdown makes them, and those that are given."""
    headings = re.findall(r"^#+ (.+)$", prose(page), flags=re.MULTILINE)
    given = [re.search(r"{#([\w-]+)}", heading) for heading in headings]
    plain = [re.sub(r"[^\w\s-]", "", re.sub(r"\]\([^)]*\)", "", one)).strip().lower() for one in headings]
    return {
        re.sub(r"[\s-]+", "-", text) if mark is None else mark[1]
        for text, mark in zip(plain, given, strict=True)
    }


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        for target, _, anchor in re.findall(r"\]\(([^)#\s]*)(#([^)\s]*))?\)", prose(page)):
            if target.startswith("http"):
                continue
            there = page.parent / target if target else page
            assert there.exists(), (name(page), target)
            assert not anchor or anchor in anchors(there), (name(page), target, anchor)


def test_counts_of_wrong_data_are_those_of_the_tables() -> None:
    for page in (ROOT / "docs" / "reference").glob("wrong-*.md"):
        text = page.read_text(encoding="utf-8")
        counts = re.findall(r"^Each of the (\d+) rows", text, flags=re.MULTILINE)
        assert counts == [
            str(len(re.findall(r"^\| .+ \| (?:refused|poor|usable) \|", text, flags=re.MULTILINE)))
        ]


def test_files_of_the_project_that_a_page_names_are_there() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for path in re.findall(r"\b((?:neurocal_cli|tests|docs/tools)/[\w/]+\.py)", text):
            assert (ROOT / path).exists(), (name(page), path)


def test_the_architecture_page_is_of_this_package() -> None:
    text = (ROOT / "docs" / "development" / "architecture.md").read_text(encoding="utf-8")
    package = ROOT / "neurocal_cli"
    way = []
    for path, folder in (("calibration", ""), ("verdict", "calibration/verdict/")):
        section = text.split(f"## The path of a {path}\n")[1].split("\n## ")[0]
        files = re.findall(r"^\| `([\w/]+\.py)`", section, flags=re.MULTILINE)
        assert 1 < len(files) <= 8
        way += [folder + file for file in files]
    types = text[text.index("## Types one meets") : text.index("## One least-squares core")]
    modules = re.findall(r"^\| `[^|]+ \| `([\w.]+)` \| ", types, flags=re.MULTILINE)
    assert modules
    for path in (*way, *(module.replace(".", "/") + ".py" for module in modules)):
        assert (package / path).exists(), path


def test_pictures_have_a_script() -> None:
    pictures = ROOT / "docs" / "pictures"
    scripts = "".join(path.read_text(encoding="utf-8") for path in pictures.glob("*.py"))
    for path in pictures.iterdir():
        if path.suffix in (".svg", ".png"):
            assert f'"{path.name}"' in scripts
            assert path.stat().st_size < 400_000


@pytest.mark.slow
def test_the_scripts_of_the_pictures_run(tmp_path: Path) -> None:
    for part in ("pictures", "how-to"):
        shutil.copytree(ROOT / "docs" / part, tmp_path / "docs" / part)
    (tmp_path / "sample_data").symlink_to(ROOT / "sample_data")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for script in sorted((tmp_path / "docs" / "pictures").glob("*.py")):
        subprocess.run([sys.executable, script], check=True, env=environment)
    words = Path("docs", "how-to", "photograph.md")  # what is said of the rendered sets
    assert agrees((ROOT / words).read_text("utf-8"), (tmp_path / words).read_text("utf-8"))


@pytest.mark.slow
def test_the_site_builds(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(tmp_path / "site")]
    subprocess.run(words, cwd=ROOT, check=True)
    assert (tmp_path / "site" / "commands" / "calibrate.html").exists()

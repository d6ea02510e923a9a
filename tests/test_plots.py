"""Pictures are drawn for whatever calibration, the same for the same one."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from support.made_calibration import made_calibration
from support.slow_cases import slow_but

from neurocal_cli import NeurocalError
from neurocal_cli.calibration import Calibration
from neurocal_cli.plots import draw_calibration

BEGINNINGS = {"png": b"\x89PNG\r\n", "pdf": b"%PDF", "svg": b"<?xml"}


@pytest.mark.parametrize("kind", slow_but(("svg",), BEGINNINGS))
def test_the_same_calibration_gives_the_same_picture(kind: str) -> None:
    picture = draw_calibration(made_calibration(2), kind)
    assert picture.startswith(BEGINNINGS[kind])
    assert draw_calibration(made_calibration(2), kind) == picture


@pytest.mark.parametrize(
    "calibration",
    [
        made_calibration(1, noise=0),
        made_calibration(45),
        replace(made_calibration(), network=None, camera_name="$x_1$ \n"),
        replace(made_calibration(), points=replace(made_calibration().points, image_size=None)),
    ],
    ids=["without noise", "many views", "no network", "no image size"],
)
def test_odd_calibrations_are_drawn(calibration: Calibration) -> None:
    assert draw_calibration(calibration).startswith(BEGINNINGS["png"])


def test_missing_matplotlib_is_said_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(NeurocalError, match=r"pip install 'neurocal\[plot\]'"):
        draw_calibration(made_calibration())


def test_drawing_leaves_the_state_of_pyplot_alone() -> None:
    code = (
        "import sys; from support.made_calibration import made_calibration;"
        "from neurocal_cli.plots import draw_calibration; draw_calibration(made_calibration());"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, check=True)

"""Real pictures and cameras, which are no part of the project: read from a folder beside it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from neurocal_cli import Correspondences

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data"
RealFiles = Callable[[str], list[Path]]


def _find(pattern: str) -> list[Path]:
    found = sorted(FOLDER.glob(pattern))
    if not found:
        pytest.skip(f"no real data beside the project: {pattern}")
    return found


@pytest.fixture(scope="session")
def real_files() -> RealFiles:
    """Real files by a pattern, sorted; a test that needs absent ones is skipped and says which."""
    return _find


@pytest.fixture(scope="session")
def zhang() -> Correspondences:
    """Corners of five views of 8 x 8 separate squares, published by Zhang, in inches."""
    (model,) = _find("zhang_planar/Model.txt")
    board = np.loadtxt(model).reshape(-1, 2)
    board = np.column_stack([board, np.zeros(len(board))])
    pixels = [np.loadtxt(path).reshape(-1, 2) for path in _find("zhang_planar/data?.txt")]
    names = np.repeat([f"im{k}" for k in range(1, 6)], len(board))
    return Correspondences(np.tile(board, (5, 1)), np.concatenate(pixels), names, (640, 480), unit="inch")

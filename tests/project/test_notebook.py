"""The user's own loop in a notebook, executed as Jupyter does."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from consoles import ROOT, blocks, prepare


@pytest.mark.slow
def test_the_page_of_the_user_s_own_loop_runs_in_a_notebook(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    prepare(tmp_path)
    page = (ROOT / "docs" / "how-to" / "own-loop.md").read_text(encoding="utf-8")
    cells = [block.text for block in blocks(page) if block.kind == "python"]
    cells += ["camera", "plot(camera)", "rig", "points", "%xmode Plain", "detect_points(None, board)"]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    client = nbclient.NotebookClient(
        notebook, timeout=120, allow_errors=True, resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    outputs = [cell.outputs for cell in notebook.cells]
    assert all(one.output_type != "error" for cell in outputs[:-1] for one in cell), outputs
    camera, picture, rig, points = (cell[0].data for cell in outputs[-6:-2])
    for result in (camera, rig):
        assert "<table" in result["text/html"]
        assert "<b>good</b>" in result["text/html"]
        assert len(result["text/plain"].splitlines()) <= 3
    assert "image/png" in picture
    assert len(picture["text/plain"]) < 200
    assert points["text/plain"].count("\n") == 0
    assert outputs[-1][0].ename == "InputError"

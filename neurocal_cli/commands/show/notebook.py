"""Results as fragments of HTML, for notebooks, which have a style of their own."""

from __future__ import annotations

from html import escape

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.stereo_rig import StereoRig
from neurocal_cli.calibration.zoom.judgement import judge_lens
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.commands.show.camera_report import parameter_rows
from neurocal_cli.commands.show.html_page import table, verdict_block
from neurocal_cli.commands.show.rig_report import pose_rows
from neurocal_cli.commands.show.stereo_report import camera_rows, rig_rows
from neurocal_cli.commands.show.text import Table
from neurocal_cli.commands.show.zoom_report import network_rows


def notebook_html(result: Calibration | StereoRig | Rig | ZoomLens) -> str:
    """The verdict and the parameters of a result."""
    if isinstance(result, Calibration):
        tables: tuple[Table, ...] = (parameter_rows(result),)
    elif isinstance(result, StereoRig):
        tables = camera_rows(result), rig_rows(result)
    else:
        tables = (network_rows(result),) if isinstance(result, ZoomLens) else pose_rows(result)
    verdict = judge_lens(result) if isinstance(result, ZoomLens) else result.verdict
    head = f"<p>{escape(repr(result).splitlines()[0])}</p>"
    return "".join([head, verdict_block(verdict), *map(table, tables)])

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


def notebook_html(result: Calibration | StereoRig | Rig | ZoomLens) -> str:
    """The verdict and the parameters of a result."""
    if isinstance(result, ZoomLens):
        return verdict_block(judge_lens(result)) + f"<pre>{escape(result.summary())}</pre>"
    if isinstance(result, Calibration):
        tables = [parameter_rows(result)]
    else:
        both = [camera_rows(result), rig_rows(result)] if isinstance(result, StereoRig) else pose_rows(result)
        tables = list(both)
    head = "".join(f"<p>{escape(line)}</p>" for line in repr(result).splitlines()[:1])
    return "".join([head, verdict_block(result.verdict), *map(table, tables)])

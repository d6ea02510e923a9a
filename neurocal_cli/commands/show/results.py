"""The page and the pictures of any result for Python, and what a notebook shows of it."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Literal

from neurocal_cli.calibration.advice import advise
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.rig import Rig, StereoRig
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens
from neurocal_cli.commands.show import CAMERA_PANELS
from neurocal_cli.commands.show.camera_report import parameter_rows
from neurocal_cli.commands.show.html_page import table, verdict_block
from neurocal_cli.commands.show.rig_report import pose_rows, side_rows
from neurocal_cli.commands.show.text import Table
from neurocal_cli.commands.show.zoom_report import draw_lens, network_rows
from neurocal_cli.errors import InputError, UsageError, check_choice

Result = Calibration | Rig | ZoomLens


class Picture(bytes):
    """The bytes of a picture's file; a notebook shows a PNG."""

    def __repr__(self) -> str:
        return f"Picture of {len(self)} bytes"

    def _repr_png_(self) -> bytes | None:
        return bytes(self) if self.startswith(b"\x89PNG") else None


def report(result: Result, photographs: Mapping[str, bytes] | None = None) -> str:
    """Make the HTML page of ``neurocal report``.

    Parameters
    ----------
    result : Calibration, StereoRig, Rig or ZoomLens
    photographs : dict of bytes by view, optional
        JPEG files of the views of a Calibration.

    Returns
    -------
    page : str
        A whole page, which loads nothing from elsewhere.

    Examples
    --------
    >>> Path("report.html").write_text(report(camera), encoding="utf-8")  # doctest: +SKIP
    """
    from neurocal_cli.commands.show.html_page import Origin, versions
    from neurocal_cli.commands.show.html_reports import page_of

    if photographs and not isinstance(result, Calibration):
        raise UsageError("only the page of a Calibration shows photographs; leave them out")
    return page_of(result, Origin({}, versions=versions()), [photographs] if photographs else ())


def plot(result: Result, panel: str | None = None, kind: Literal["png", "svg", "pdf"] = "png") -> Picture:
    """Draw the picture of the option ``--plot``.

    Parameters
    ----------
    result : Calibration, StereoRig, Rig or ZoomLens
    panel : str, optional
        One panel of a camera or a pair: residuals, coverage, uncertainty, scatter, poses, learning, views; or
        ``next``, the views of a camera to take next. Default: all panels on a page.
    kind : {"png", "svg", "pdf"}

    Returns
    -------
    picture : bytes
        Of the file; a notebook shows it.

    Raises
    ------
    UsageError
        There is no such panel or kind.
    NeurocalError
        matplotlib is not installed.
    """
    if isinstance(result, Calibration) and panel == "next":
        from neurocal_cli.commands.show.advice import draw_advice

        return Picture(draw_advice(advise(result), result, kind))
    panels = CAMERA_PANELS if isinstance(result, (Calibration, StereoRig)) else ()
    if panel is not None:
        if not panels:
            raise UsageError("this result has a single picture; leave out panel")
        check_choice("panel", panel, (*panels, "next") if isinstance(result, Calibration) else panels)
    if isinstance(result, ZoomLens):
        return Picture(draw_lens(result, kind))
    from neurocal_cli.commands.show.plot_pages import draw_camera, draw_rig, draw_stereo

    if isinstance(result, StereoRig):
        return Picture(draw_stereo(result, kind, panel))
    if isinstance(result, Rig):
        return Picture(draw_rig(result, kind))
    if not len(result.points):
        raise InputError("the calibration holds no points; give one that was not written with --lean")
    from neurocal_cli.commands.show.camera_panels import Subject

    return Picture(draw_camera(Subject.of(result), kind, panel))


def notebook_html(result: Calibration | Rig | ZoomLens) -> str:
    """The verdict and the parameters of a result."""
    if isinstance(result, Rig):
        tables: tuple[Table, ...] = side_rows(result), *pose_rows(result)
    else:
        tables = (network_rows(result) if isinstance(result, ZoomLens) else parameter_rows(result),)
    head = f"<p>{escape(repr(result).splitlines()[0])}</p>"
    return "".join([head, verdict_block(result.verdict), *map(table, tables)])

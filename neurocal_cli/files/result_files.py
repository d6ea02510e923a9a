"""Write a calibration or a rig as YAML, JSON or OpenCV's XML, depending on the file's extension.

JSON contains the same tree as YAML. XML is the format of `cv2.FileStorage`, with only the cameras and the
poses of views. A lean file contains only the camera and the verdict, without points, poses and the record of
the network.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.files.calibration_yaml import format_calibration
from neurocal_cli.files.writing import write_whole

if TYPE_CHECKING:
    from neurocal_cli.calibration.rig.rig import Rig


def write_calibration(cal: Calibration, path: str | Path) -> None:
    """Write a calibration file, whole or not at all; ``-`` is stdout.

    The extension ``.json`` or ``.xml`` gives JSON or OpenCV's XML, see `write_result`.
    """
    write_result(cal, path)


def write_rig(rig: Rig, path: str | Path, alpha: float | None = None) -> None:
    """Write a rig file, whole or not at all; ``-`` is stdout.

    The extension ``.json`` or ``.xml`` gives JSON or OpenCV's XML, see `write_result`.
    """
    write_result(rig, path, alpha=alpha)


def write_result(
    result: Calibration | Rig, path: str | Path, *, lean: bool = False, alpha: float | None = None
) -> tuple[str, ...]:
    """Write a calibration or a rig, whole or not at all.

    The extension ``.json`` gives JSON, ``.xml`` gives XML; all others give YAML. A `lean` file lacks points,
    poses and the record of the network. `alpha` is that of a rig's rectification, see `rectify`. Returns what
    the file cannot represent exactly, such as skew in XML.
    """
    if lean:
        result = result.lean
    ending = os.path.splitext(str(path))[1].lower()
    # Modules of other formats are imported only if they are needed.
    if ending == ".xml":
        from neurocal_cli.files.exchange.reading import converted

        found = converted(result, "opencv", None, force=False, ending=ending)
        write_whole(path, found.files[""])
        return (*found.warnings, *found.remarks)
    by_rows = ending == ".json"  # JSON loads fast at any length
    if isinstance(result, Calibration):
        text = format_calibration(result, by_rows)
    else:
        from neurocal_cli.files.rig_yaml import format_rig

        text = format_rig(result, alpha, by_rows)
    if by_rows:
        from neurocal_cli.files.yaml_text import parse_yaml

        text = _lines(parse_yaml(text, "the calibration"), 3) + "\n"
    write_whole(path, text)
    return ()


def _lines(value: Any, depth: int, indent: str = "") -> str:
    """JSON with one entry of the upper levels per line."""
    inner = indent + "  "
    if depth and isinstance(value, dict) and value:
        parts = [f"{inner}{json.dumps(key)}: {_lines(part, depth - 1, inner)}" for key, part in value.items()]
        return "{\n" + ",\n".join(parts) + f"\n{indent}}}"
    if depth and isinstance(value, list) and any(isinstance(part, (list, dict)) for part in value):
        parts = [inner + json.dumps(part, ensure_ascii=False, allow_nan=False) for part in value]
        return "[\n" + ",\n".join(parts) + f"\n{indent}]"
    return json.dumps(value, ensure_ascii=False, allow_nan=False)

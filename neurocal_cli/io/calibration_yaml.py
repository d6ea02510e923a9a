"""Calibration files: a camera, how sure it is, and what it was found from, in one YAML file.

The file is a ROS camera_info file with a block ``neurocal``; numbers read back to the last bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from neurocal_cli.calibration import Calibration
from neurocal_cli.io.calibration_text import calibration_lines
from neurocal_cli.io.files import write_whole

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["format_calibration", "read_calibration", "write_calibration"]


def format_calibration(cal: Calibration) -> str:
    """Text of a calibration file.

    The same calibration gives the same text; it holds no dates and no paths.

    Raises
    ------
    InputError
        A name that UTF-8 cannot hold.
    """
    return "\n".join([*calibration_lines(cal), ""])


def write_calibration(cal: Calibration, path: str | Path) -> None:
    """Write a calibration file, whole or not at all; ``-`` is stdout."""
    write_whole(path, format_calibration(cal))


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file that neurocal wrote; ``-`` is stdin.

    Raises
    ------
    FormatError
        The file cannot be read, is no YAML, or a key is missing or wrong.
    """
    # Parsing YAML takes 20 ms to load, which a command that only writes does not wait for.
    from neurocal_cli.io.calibration_tree import calibration_from_field
    from neurocal_cli.io.tree_fields import Field
    from neurocal_cli.io.yaml_tree import read_yaml

    tree, source = read_yaml(path)
    return calibration_from_field(Field(tree, source))

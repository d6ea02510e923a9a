"""How a result came about, which its page tells to those who want to repeat it."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import field
from importlib.metadata import PackageNotFoundError, version

from neurocal_cli import __version__
from neurocal_cli.frozen_dataclass import frozen_dataclass


@frozen_dataclass
class Origin:
    """The run that gave a result, as far as it is known.

    Attributes
    ----------
    files : dict of str by name
        SHA-256 of the files that it was made from; the result's own file where the run is not known.
    command : str, optional
        What was typed.
    versions : dict of str by name
        Of the programs that computed it.
    """

    files: Mapping[str, str]
    command: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)


def versions() -> dict[str, str]:
    """The versions of what computes now."""
    found = {"neurocal": __version__, "Python": platform.python_version()}
    for name in ("numpy", "scipy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # installed by other means than a package
            continue
    return found

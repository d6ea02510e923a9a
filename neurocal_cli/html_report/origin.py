"""Origin of a result, shown on its page so that it can be reproduced."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import field
from importlib.metadata import PackageNotFoundError, version

from neurocal_cli import __version__
from neurocal_cli.frozen_dataclass import frozen_dataclass


@frozen_dataclass
class Origin:
    """The run that produced a result, as far as known.

    Attributes
    ----------
    files : dict of str by name
        SHA-256 of the input files; of the result's own file if the run is unknown.
    command : str, optional
        The command line.
    versions : dict of str by name
        Of the programs that computed the result.
    """

    files: Mapping[str, str]
    command: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)


def versions() -> dict[str, str]:
    """Versions of the running programs."""
    found = {"neurocal": __version__, "Python": platform.python_version()}
    for name in ("numpy", "scipy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # not installed as a package
            continue
    return found

"""The sample data, which is installed with the package; of a source tree, the folder beside it.

It is installed as it stands in the project, and not simulated again, so that it is the same on every computer
and with every version of NumPy: the documentation shows results from it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from neurocal_cli.errors import NeurocalError, one_line
from neurocal_cli.files.reading import read_bytes
from neurocal_cli.files.writing import make_folder, write_whole

_KINDS = (".csv", ".jpg", ".png", ".md")  # the scripts that made the data stay in the project
_INSTALLED = "share/neurocal/sample_data/README.md"  # in pyproject.toml


def write_sample_data(folder: str) -> list[str]:
    """Write the sample data into a folder, which is made if it does not exist; return the names of all files.

    Files that are there already are left as they are; one with other content is a NeurocalError.
    """
    source = next((one for one in _sources() if (one / "README.md").is_file()), None)
    if source is None:
        raise NeurocalError("the sample data is not installed; install neurocal again with pip")
    files = sorted(file for file in source.iterdir() if file.suffix in _KINDS)
    make_folder(folder)
    for file in files:
        path, content = os.path.join(folder, file.name), read_bytes(file)[0]
        if not os.path.exists(path):
            write_whole(path, content)
        elif os.path.isdir(path) or read_bytes(path)[0] != content:
            raise NeurocalError(f"{one_line(path)}: is no file of the sample data; give another folder")
    return [file.name for file in files]


def _sources() -> Iterator[Path]:
    """Folders that may hold the sample data."""
    project = Path(__file__).resolve().parents[2]
    if (project / "pyproject.toml").is_file():
        yield project / "sample_data"
    try:
        installed = distribution("neurocal")
    except PackageNotFoundError:
        return
    for file in installed.files or ():
        if file.as_posix().endswith(_INSTALLED):
            yield Path(str(installed.locate_file(file))).resolve().parent

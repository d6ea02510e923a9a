"""The output files of ``neurocal undistort``."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping, Sequence

from neurocal_cli.commands.streams import is_terminal
from neurocal_cli.errors import UsageError


def places_of(paths: Sequence[str], output: str) -> tuple[str | None, list[str]]:
    """The output folder, if the output is one, and the output file of each input.

    Raises
    ------
    UsageError
        The output cannot hold several files or an image.
    """
    if not paths:
        return None, []
    folder = _folder(paths, output)
    return folder, [output] if folder is None else [os.path.join(folder, _name(path)) for path in paths]


def _folder(paths: Sequence[str], output: str) -> str | None:
    from neurocal_cli.io.image_paths import is_image

    several = len(paths) > 1
    if output == "-":
        if several:
            raise UsageError("several files cannot go to standard output; give a folder, -o DIR")
        if is_image(paths[0]) and is_terminal(sys.stdout):
            raise UsageError("an image cannot be shown on a terminal; give a file, -o FILE")
        return None
    unlike = is_image(paths[0]) and not is_image(output)
    if not (several or os.path.isdir(output) or output.endswith(os.sep) or unlike):
        return None
    if os.path.exists(output) and not os.path.isdir(output):
        raise UsageError(f"-o {output} is a file; give a folder")
    return output


def _name(path: str) -> str:
    from neurocal_cli.io.image_paths import is_image

    if path == "-":
        return "points.csv"
    name = os.path.basename(path)
    return os.path.splitext(name)[0] + ".png" if is_image(path) else name


def check_distinct(
    inputs: Iterable[str], outputs: Sequence[str], paths: Sequence[str], others: Mapping[str, str | None]
) -> None:
    """Refuse to overwrite inputs, or to write two results to the same file.

    Parameters
    ----------
    inputs : iterable of str
    outputs, paths : sequences of str of one length
        Output files, and the inputs from which they are made.
    others : dict
        Further output files by their content.

    Raises
    ------
    UsageError
        The message names the two files that collide.
    """
    read = {os.path.realpath(path) for path in inputs if path != "-"}
    taken: dict[str, str] = {}
    targets = list(zip(outputs, paths, strict=True))
    targets += [(place, what) for what, place in others.items() if place is not None]
    for target, source in targets:
        place = os.path.realpath(target) if target != "-" else "-"
        if place in read:
            raise UsageError(f"{target} is an input and would be overwritten; give another output")
        if place in taken:
            raise UsageError(f"{taken[place]} and {source} would both be written to {target}; rename one")
        taken[place] = source

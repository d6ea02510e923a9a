"""``neurocal sample``: the data of all examples."""

from __future__ import annotations

import os

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.streams import say, suggest


@click.command(cls=options.Command)
@options.argument("folder", "DIR", "Folder to write the sample data to; it is made if it does not exist.")
def sample(folder: str) -> None:
    """Write the sample data, with which all examples work.

    The folder then has simulated points of single cameras, of stereo pairs, rigs and a zoom lens, and
    rendered photographs of a chessboard. Its README.md tells what each file shows, and the true cameras.
    Files that are there already are left as they are; a file of such a name with other content is an error.

    \b
    Examples:
      neurocal sample sample_data
      neurocal detect sample_data/photo*.jpg --square 25 -o points.csv
      neurocal calibrate points.csv -o camera.yaml
    """  # noqa: D301 - as in the group
    preparation.check_folder("DIR", folder)
    from neurocal_cli.files.sample_data import write_sample_data

    names = write_sample_data(folder)
    say(f"{os.path.join(folder, 'README.md')} tells what the {len(names)} files show")
    suggest(os.path.join(folder, "photo"), "neurocal detect {}*.jpg --square 25 -o points.csv")

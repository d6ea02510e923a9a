"""What all results can show of themselves, and their forms for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from neurocal_cli.camera.distortion import Model
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.late_import import late
from neurocal_cli.errors import UsageError

Program = Literal[
    "neurocal", "opencv", "ros", "kalibr", "colmap", "mrcal", "matlab", "json", "npz", "dlt", "nerfstudio",
    "anipose", "caliscope", "orb-slam", "vins", "basalt", "euroc", "open3d", "metashape", "gyroflow",
    "lensfun",
]  # fmt: skip


@frozen_dataclass(eq=False)
class Converted:
    """A result in the format of another program.

    Attributes
    ----------
    files : dict of str or bytes by name
        The name is empty if there is a single file.
    warnings : tuple of str
        What changed, such as skew that the program ignores, and by how many pixels.
    remarks : tuple of str
        What the format cannot store.
    """

    files: Mapping[str, str | bytes]
    warnings: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The text of a single file; raises UsageError for several files, or one of bytes."""
        text = self.files.get("")
        if not isinstance(text, str):
            raise UsageError("the format has several files, or none of text; use `files`")
        return text


class Summarised:
    """A result with a summary: as text, and as a page fragment in notebooks."""

    _summary: ClassVar[tuple[str, str]]  # module and name of the function

    def summary(self) -> str:
        """What the command that makes such a result prints, with the verdict, without the warnings."""
        return str(late(*self._summary)(self))

    def _repr_html_(self) -> str:
        """HTML that a notebook shows: the parameters and the verdict."""
        return str(late("commands.show.results", "notebook_html")(self))


class Presented(Summarised):
    """A summarised result that other programs can read."""

    def convert(
        self, to: Program, *, model: Model | None = None, force: bool = False, ending: str = ".yaml"
    ) -> Converted:
        """Convert to the format of another program, as the command ``neurocal convert``.

        Parameters
        ----------
        to : str
            The program.
        model : str, optional
            Convert to the nearest camera of this distortion model.
        force : bool
            If the format lacks the distortion model, convert to the nearest camera of one that it has.
        ending : str
            Of the file's name, for formats with several forms: OpenCV's ``.yaml``, ``.xml`` and ``.json``.

        Raises
        ------
        UsageError
            There is no such format.
        InputError
            The format cannot represent the result; the message says why, and what can be done.
        """
        found: Converted = late("files.exchange.reading", "converted")(self, to, model, force, ending)
        return found

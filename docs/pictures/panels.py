"""The page of panels that ``--plot`` draws, of the sample camera."""

from __future__ import annotations

from pathlib import Path

from neurocal_cli import calibrate, read_points
from neurocal_cli.commands.show.camera_panels import Subject
from neurocal_cli.commands.show.plot_pages import draw_camera

HERE = Path(__file__).resolve().parent
SAMPLES = HERE.parents[1] / "sample_data"


def main() -> None:
    """Draw ``panels.png``."""
    found = calibrate(read_points(str(SAMPLES / "flat.csv")), skew=False)
    (HERE / "panels.png").write_bytes(draw_camera(Subject.of(found)))


if __name__ == "__main__":
    main()

"""Draw the bent board of the sample data as a calibration finds it; writes ``target.svg``."""

from __future__ import annotations

from pathlib import Path

from neurocal_cli import calibrate, read_points
from neurocal_cli.commands.show.camera_panels import draw_target

HERE = Path(__file__).resolve().parent


def main() -> None:
    """Calibrate the sample, and write the picture."""
    points = read_points(str(HERE.parents[1] / "sample_data" / "bent.csv"))
    found = calibrate(points)
    assert found.target is not None
    (HERE / "target.svg").write_bytes(draw_target(found.target, points.unit, "svg"))


if __name__ == "__main__":
    main()

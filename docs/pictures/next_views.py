"""The outlines that `neurocal advise` draws, for the sample data."""

from __future__ import annotations

from style import HERE, SAMPLES

from neurocal_cli import calibrate, read_points
from neurocal_cli.calibration.advice import advise
from neurocal_cli.commands.show.advice import draw_advice


def main() -> None:
    calibration = calibrate(read_points(str(SAMPLES / "flat.csv")))
    (HERE / "next-views.png").write_bytes(draw_advice(advise(calibration, 3), calibration, "png"))


if __name__ == "__main__":
    main()

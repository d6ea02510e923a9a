"""The figures of the page of results, as the commands draw them."""

from __future__ import annotations

from pathlib import Path

from neurocal_cli.commands.show.methods_report import draw_rates, draw_simulation
from neurocal_cli.files.processes import usable_cores
from neurocal_cli.simulation.comparison import study_noise
from neurocal_cli.simulation.scenes import paper_scene
from neurocal_cli.simulation.starts import study_rates, study_starts

HERE = Path(__file__).resolve().parent
SIGMA = (0.1, 0.2, 0.5, 1.0, 2.0)
METHODS = ("neuro", "backprop", "nonlinear", "linear", "tsai")


def main() -> None:
    scene, jobs = paper_scene(), usable_cores()
    errors = study_noise(scene, SIGMA, 50, METHODS, jobs=jobs)
    starts = study_starts(scene, 0.5, 200, jobs=jobs)
    (HERE / "fig1.png").write_bytes(draw_simulation(errors, starts, scene.unit))
    (HERE / "rates.png").write_bytes(draw_rates(study_rates(70, jobs=jobs)))


if __name__ == "__main__":
    main()

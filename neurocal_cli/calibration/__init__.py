"""From points to a calibrated camera: which lens, which points and which target, and how well it is known.

The way of a calibration:

1. `calibrate` checks what the user gives and asks for, and states it as a `Problem`.
2. `fit` solves it from random weights, adjusts camera and poses, and selects the distortion model
   (`lens_choice`).
3. `outlier_rejection` leaves out points and views that contradict the others.
4. `target_choice` estimates the shape of the target with the camera if the data support that and nothing else
   explains them (`other_causes`). `rich_choice` tries the most flexible lens if systematic errors remain.
5. `result` converts the solution to pixels and world units, with standard deviations and warnings: a
   `Calibration` (`calibration`). Its verdict is computed when it is first read (`verdict`).

`other_methods` replace steps 2 to 4. `rig` calibrates two cameras that are fixed to each other and `zoom` a
zoom lens, both from calibrations of single cameras. `evaluation` measures the error of a calibrated camera on
other points, and `advice` chooses the views to take next.
"""

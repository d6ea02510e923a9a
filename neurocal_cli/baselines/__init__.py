"""The calibration methods that the paper compares its network with, and OpenCV's.

Each is a function of a `Problem` that returns a `Found`, which `calibrate_by` makes into a `Calibration` as
for the network. None of them shares its algorithm with the network, so each is also an independent check
of it.
"""

"""The methods that the paper compares with its network, and OpenCV's `calibrateCamera`.

Each is a function of a `Problem` that returns a `Found`; `calibrate_by` converts it to a `Calibration` as for
the network. None of them shares its solution method with the network, so each is also an independent check.
"""

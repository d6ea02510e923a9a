"""The methods that the paper compares its network with, and OpenCV: from points to a camera, each by itself.

Each is a function of a `Problem` that returns a `Found`; `calibrate_by` makes a `Calibration` of it, as the
network's is made. None of them shares its way to the answer with the network, so that each is also an
independent check of it.
"""

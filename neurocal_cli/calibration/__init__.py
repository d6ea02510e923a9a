"""From a problem to a calibration: model selection, outlier rejection, the target's shape, the result."""

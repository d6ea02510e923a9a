"""From a problem to a calibration: the fit with its distortion model, without outliers, and the result."""

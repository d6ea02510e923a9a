"""From a search to a calibration: the fit with its lens, without the points that lie, and what comes out."""

"""A verdict on a calibration: the evidence, the word, the reasons and the advice."""

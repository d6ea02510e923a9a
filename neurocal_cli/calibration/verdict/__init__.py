"""The verdict on a calibration: measures, rules, reasons and advice."""

"""Camera files of other programs: one module per format, which converts to and from a `CameraSet`."""

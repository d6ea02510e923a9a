"""Camera files of other programs: each format one module, and between them one `CameraSet`."""

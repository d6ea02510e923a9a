"""Files in and out: the only part of the package that knows about text formats and paths."""

"""Reading and writing files: the only part of the package that handles file formats and paths."""

"""Read and write files: the only part of the package that knows text formats and paths."""

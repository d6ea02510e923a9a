"""Read and write files: the only part of the package that opens them and knows their formats.

Every function that reads raises a `FormatError` if the file is missing, unreadable or malformed. The message
names the file, the line or key, and what to do. A function that writes raises a `NeurocalError` if the file
cannot be written, and an `InputError` if its format cannot hold a value. The path ``-`` is stdin or stdout.
"""

"""Reports as single HTML pages, which need no internet access and print well."""

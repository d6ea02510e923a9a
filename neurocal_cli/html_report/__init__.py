"""Reports as self-contained HTML pages, which also print well."""

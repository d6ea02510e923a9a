"""Entry point of ``neurocal`` and of ``python -m neurocal_cli``."""

from __future__ import annotations

import gc
import sys
import warnings

__all__ = ["main"]


def main() -> None:
    """Run the command line and leave with its exit code."""
    if not sys.warnoptions:
        # Warnings of the libraries below are for their developers; what a user should know is in
        # the result's own warnings.
        warnings.simplefilter("ignore")
    # A command makes many lists and few cycles: looking for these every 700 objects took 5 % of its time.
    gc.set_threshold(100_000, 20, 20)
    try:
        from neurocal_cli.commands import neurocal

        neurocal(prog_name="neurocal")
    except KeyboardInterrupt:  # pressed while modules are still being loaded
        sys.exit(130)


if __name__ == "__main__":
    main()

"""Entry point of ``neurocal`` and of ``python -m neurocal_cli``."""

from __future__ import annotations

import atexit
import gc
import signal
import sys
import warnings
from contextlib import suppress


def main() -> None:
    """Run the command line and leave with its exit status."""
    if not sys.warnoptions:
        # Warnings of the libraries below are for their developers; what a user should know is in
        # the result's own warnings.
        warnings.simplefilter("ignore")
    # A command makes few reference cycles and ends soon. Looking for them every 700 objects took 5 % of the
    # time on 1000 views; looking once more at the exit, through every module, took 25 ms of any command.
    gc.set_threshold(300_000, 20, 20)
    atexit.register(gc.freeze)
    # Ended as if interrupted: what is half written is cleared away. `nohup` ignores the end of the terminal.
    for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):  # not on Windows
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, lambda number, frame: sys.exit(128 + number))
    try:
        from neurocal_cli.commands import neurocal
        from neurocal_cli.commands.streams import stand_in_for_closed_stdout

        stand_in_for_closed_stdout()
        neurocal(prog_name="neurocal")
    except KeyboardInterrupt:  # pressed while modules are still being loaded
        if sys.stderr is not None:
            sys.stderr.write("Error: interrupted\n")
        sys.exit(130)
    finally:
        # Python takes some ms to end, in which an interrupt would kill it whatever its exit status is. One
        # that has just come is raised by the first of the two calls.
        with suppress(KeyboardInterrupt):
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # It also kills itself at its end if an interrupt came while a text was evaluated, as some modules do
        # when they are loaded, even if the interrupt was handled. The next evaluation makes it forget that.
        eval("0")


if __name__ == "__main__":
    main()

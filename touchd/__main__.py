"""`python -m touchd`, and the console script."""

import io
import os
import sys

from touchd.service.signals import hold


def open_streams() -> None:
    """Open standard streams that were closed at the start, on nothing: Python has None for each.

    Of a character that the locale cannot write, standard output has the escape, as standard error does.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115 - as long as the process
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def run() -> None:
    """Run the command line and exit with its status."""
    open_streams()
    hold()  # before the imports, which take a tenth of a second
    try:
        from touchd.cli.main import main
    except KeyboardInterrupt:
        sys.exit(130)

    sys.exit(main())


if __name__ == "__main__":
    run()

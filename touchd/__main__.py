"""`python -m touchd`, and the console script."""

import sys

from touchd.service.signals import hold


def run() -> None:
    """Run the command line and exit with its status."""
    hold()  # before the imports, which take a tenth of a second
    try:
        from touchd.cli.main import main
    except KeyboardInterrupt:
        sys.exit(130)

    sys.exit(main())


if __name__ == "__main__":
    run()

"""Command lines that start this Python again, with this process's packages.

The Debian package's launcher adds its packages to `sys.path` itself, so `python -m touchd` would not find them.
"""

from __future__ import annotations

import sys


def python(code: str, *arguments: str) -> list[str]:
    """Return the command line that runs `code` in a process of its own."""
    return [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; {code}", *arguments]


def verb(*arguments: str) -> list[str]:
    """Return the command line that runs touchd with `arguments`, in a process of its own."""
    return python("from touchd.__main__ import run; run()", *arguments)

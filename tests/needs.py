"""What a test needs of the computer: it is skipped with the reason where that is missing, and fails under CI."""

from __future__ import annotations

import os
import shutil

import pytest


def need(there: object, reason: str) -> None:
    """Skip the test, or the test module at its import, with the reason, unless the thing is there.

    Under CI=true that is a failure.
    """
    if there:
        return
    if os.environ.get("CI") == "true":
        pytest.fail(f"{reason}; with CI=true nothing is skipped")
    pytest.skip(reason, allow_module_level=True)


def need_tool(name: str, package: str) -> str:
    """Return the path of a program of the system."""
    path = shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
    need(path, f"{name} is missing: apt install {package}")
    assert path is not None
    return path

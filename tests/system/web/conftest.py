"""A bus for the page's server, in the place of the daemon's."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.system.web.rig import bus


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    where = f"ipc://{tmp_path_factory.mktemp('bus')}/bus"
    with bus(where):
        yield where

"""A database of the fleet's collector, in a file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.fleet.store import Store


@pytest.fixture
def database(tmp_path: Path) -> str:
    return str(tmp_path / "fleet.sqlite")


@pytest.fixture
def store(database: str) -> Iterator[Store]:
    one = Store(database)
    one.prepare()
    yield one
    one.close()

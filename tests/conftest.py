"""What holds for all tests."""

from __future__ import annotations

import gc

import pytest


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Two thousand collected tests never become garbage: do not look through them at every collection."""
    gc.collect()
    gc.freeze()

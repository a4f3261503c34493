"""What holds for all tests."""

from __future__ import annotations

import gc
import signal

import hypothesis
import pytest

# How long an example takes says something of the machine, not of the code.
hypothesis.settings.register_profile("anywhere", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow])
hypothesis.settings.load_profile("anywhere")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # So it is under `nohup` and in the background of a script, and every command that a test starts would inherit it:
    # what is told to stop by Ctrl-C would never stop.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Two thousand collected tests never become garbage: do not look through them at every collection."""
    gc.collect()
    gc.freeze()

"""The autopilots under test: doubles always, binaries where the environment names them.

ARDUPILOT_SITL: path of `arducopter`. PX4_SITL: path of `px4`; its etc folder is `../etc` of it, or PX4_SITL_ETC.
"""

from __future__ import annotations

import faulthandler
from collections.abc import Iterator

import pytest

from tests.sitl.craft import BINARIES, KINDS, Autopilot, BinaryError, DoubleAutopilot, SitlAutopilot, missing


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrise by autopilot; `@pytest.mark.only("px4", "sitl")` keeps those whose name has all the words."""
    if "autopilot" not in metafunc.fixturenames:
        return
    words = [word for mark in metafunc.definition.iter_markers("only") for word in mark.args]
    kinds = [kind for kind in KINDS if all(word in kind for word in words)]
    values = [pytest.param(kind, marks=[pytest.mark.sitl] if kind in BINARIES else []) for kind in kinds]
    metafunc.parametrize("autopilot", values, indirect=True, scope="session")


@pytest.fixture(autouse=True)
def unhurried() -> None:
    """Each of these tests has a bound of its own, some beyond the time after which others count as hanging."""
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture(scope="session")
def autopilot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Autopilot]:
    """One of the four; a binary is started once and kept for all tests that want it."""
    kind: str = request.param
    reason = missing(kind)
    if reason is not None:
        pytest.skip(reason)
    if kind not in BINARIES:
        yield DoubleAutopilot(kind)
        return
    try:
        running = SitlAutopilot(kind, tmp_path_factory.mktemp(kind))
    except BinaryError as error:
        pytest.fail(str(error), pytrace=False)
    yield running
    running.close()

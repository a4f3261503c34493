"""Rules for all tests: which are quick, which wait for a clock, the time limit of each, what none may leave behind."""

from __future__ import annotations

import asyncio
import gc
import inspect
import json
import os
import signal
import sys
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, Final

import hypothesis
import pytest

from tests.support.extent import LONG
from tests.support.outside import Outside
from tests.support.virtual_time import run_virtual

# How long an example takes says something of the machine, not of the code. Every day the examples are the same for
# everybody: a suite is green or red, and no matter of dice. Those of `make long` are new every time.
hypothesis.settings.register_profile(
    "anywhere",
    max_examples=30,
    deadline=None,
    derandomize=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.register_profile(
    "long", hypothesis.settings.get_profile("anywhere"), derandomize=False, max_examples=1000
)
hypothesis.settings.load_profile("long" if LONG else "anywhere")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # So it is under `nohup` and in the background of a script, and every command that a test starts would inherit it:
    # what is told to stop by Ctrl-C would never stop.
    signal.signal(signal.SIGINT, signal.default_int_handler)

TESTS: Final = Path(__file__).parent
DURATIONS: Final = TESTS / "durations.json"
"""Processor time of every test that takes more than half a second, by its name, in seconds."""
WORTH_NOTING_S: Final = 0.5
QUICK_S: Final = 0.5
"""The most processor time of a test that `make quick` runs."""
LONG_LIMIT_S: Final = 7200.0
"""Time limit of a test with a real autopilot, or of `make long`; others have that of pyproject.toml."""
LIMIT_AGAIN_S: Final = 60.0
"""Interval at which a test beyond its limit is interrupted again: an exception may end in a task that nobody awaits."""
OUTSIDE: Final = pytest.StashKey[Outside]()
QUICK_ROOMS: Final = ("unit", "property")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--quick", action="store_true", help="unit and property tests without real clock and processes")
    parser.addoption("--write-durations", action="store_true", help=f"note in {DURATIONS.name} how long tests took")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files without a test of the real clock where only those are wanted: importing them takes seconds."""
    wanted = config.getoption("markexpr")
    if not wanted.startswith("real_clock") or not collection_path.name.startswith("test_"):
        return None
    text = collection_path.read_text(encoding="utf-8")
    if "not sitl" in wanted and "\npytestmark = pytest.mark.sitl\n" in text:
        return True
    return None if "real_clock" in text else True


def durations() -> dict[str, float]:
    read: dict[str, float] = json.loads(DURATIONS.read_text(encoding="utf-8")) if DURATIONS.exists() else {}
    return read


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if LONG or item.get_closest_marker("sitl") is not None:
            item.add_marker(pytest.mark.timeout(LONG_LIMIT_S))
    if LONG:
        _choose(config, items, lambda item: "extent" in vars(item.module) or hasattr(item.function, "hypothesis"))
    if config.getoption("quick"):
        took_s = durations()
        _choose(config, items, lambda item: _is_quick(item, took_s))


def _is_quick(item: pytest.Function, took_s: dict[str, float]) -> bool:
    return (
        item.path.relative_to(TESTS).parts[0] in QUICK_ROOMS
        and item.get_closest_marker("real_clock") is None
        and took_s.get(item.nodeid, 0.0) <= QUICK_S
    )


def _choose(config: pytest.Config, items: list[pytest.Item], wanted: Callable[[Any], bool]) -> None:
    chosen: list[pytest.Item] = []
    others: list[pytest.Item] = []
    for item in items:
        (chosen if wanted(item) else others).append(item)
    items[:] = chosen
    config.hook.pytest_deselected(items=others)


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine: on virtual time, or on the real clock where a mark says so."""
    test = pyfuncitem.obj
    if not inspect.iscoroutinefunction(test):
        return None
    run = run_virtual if _is_on_virtual_time(pyfuncitem) else asyncio.run
    run(test(**{name: pyfuncitem.funcargs[name] for name in inspect.signature(test).parameters}))
    return True


def _is_on_virtual_time(item: pytest.Item) -> bool:
    return not any(item.get_closest_marker(mark) for mark in ("real_clock", "sitl", "sockets"))


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Two thousand collected tests never become garbage: do not look through them at every collection."""
    gc.collect()
    gc.freeze()


class _Running:
    on_virtual_time = False


def _refuse_process(event: str, _arguments: object) -> None:
    if _Running.on_virtual_time and event in ("subprocess.Popen", "os.fork", "os.posix_spawn"):
        msg = f"{event} in a test that is not marked real_clock"
        raise RuntimeError(msg)


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("quick"):  # in all tests it costs 7 % of the time
        sys.addaudithook(_refuse_process)
    if not hasattr(config, "workerinput"):
        config.stash[OUTSIDE] = Outside()


def pytest_sessionfinish(session: pytest.Session) -> None:
    outside = session.config.stash.get(OUTSIDE, None)
    if outside is not None and outside.compare():
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_unconfigure(config: pytest.Config) -> None:
    if (outside := config.stash.get(OUTSIDE, None)) is not None:
        outside.close()


@pytest.hookimpl(wrapper=True)
def pytest_timeout_set_timer(settings: Any) -> Generator[None, object, object]:
    done = yield
    if settings.method == "signal":
        signal.setitimer(signal.ITIMER_REAL, settings.timeout, LIMIT_AGAIN_S)
    return done


def _processor_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


_began_s: dict[str, float] = {}
"""The processor time at the start of the test that runs."""


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    _began_s[item.nodeid] = _processor_s()
    _Running.on_virtual_time = _is_on_virtual_time(item)
    done = yield
    _Running.on_virtual_time = False
    return done


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if report.when == "teardown":
        report.user_properties.append(("processor_s", _processor_s() - _began_s.pop(item.nodeid)))
    return report


_took_s: dict[str, float] = {}


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    for name, value in report.user_properties:
        if name == "processor_s":
            _took_s[report.nodeid] = float(str(value))


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Name what was left outside, and what is too slow for `make quick`: `--write-durations` leaves that out."""
    outside = config.stash.get(OUTSIDE, None)
    if outside is not None and outside.left:
        terminalreporter.section("left outside tmp_path", red=True)
        for path in outside.left:
            terminalreporter.line(f"{path}: new since the start of the run; a test may write below tmp_path only")
    if config.getoption("quick"):
        slow = sorted(((took_s, name) for name, took_s in _took_s.items() if took_s > QUICK_S), reverse=True)
        if slow:
            terminalreporter.section(f"more than {QUICK_S:g} s of processor time: too slow for `make quick`")
        for took_s, name in slow:
            terminalreporter.line(f"{took_s:6.1f} s  {name}")
    if config.getoption("write_durations"):
        noted = {name: took_s for name, took_s in durations().items() if name not in _took_s}
        noted |= {name: round(took_s, 1) for name, took_s in _took_s.items() if took_s > WORTH_NOTING_S}
        alive = {name: noted[name] for name in sorted(noted) if (TESTS.parent / name.split("::")[0]).exists()}
        DURATIONS.write_text(json.dumps(alive, indent=0) + "\n", encoding="utf-8")
        terminalreporter.line(f"{sum(_took_s.values()):.0f} s of processor time; {DURATIONS.name} written")

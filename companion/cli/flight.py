"""`companion flight`: what a log of the autopilot says of a flight."""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from companion.cli.terminal import AddCommand, conclude, print_lines, storage_path
from companion.errors import StorageError
from companion.estimation.records.flight_record import (
    HEADS,
    UNSEEN,
    Flight,
    ImuFlight,
    KeptFlight,
    Term,
    drift_lines,
    next_flight,
)
from companion.physics.units import unit_of

if TYPE_CHECKING:
    from companion.lab.flight.flight import Knowledge
    from companion.storage.records import FlightStore


def add_commands(add: AddCommand) -> None:
    command = add("flight", flight, "what a log of the autopilot says of a flight")
    command.add_argument("file", type=Path, metavar="LOG", help="ArduPilot's .bin or PX4's .ulg")


async def flight(options: argparse.Namespace) -> int:
    from companion.lab.flight.flight import flights, read

    path = options.file
    known, store = _knowledge(options)
    starts, imus, lines, found = 0, 0, [], []
    for boot in read(path):
        starts, imus = starts + 1, imus + len(boot.imus)
        for each in await flights(boot, known):
            found.append(each)
            lines += _flight_lines(starts, each)
    if not imus:
        raise StorageError(f"{path}: no samples of an IMU in it")
    if not found:
        raise StorageError(f"{path}: no attitude and position of an EKF3 (ArduPilot) or EKF2 (PX4) in it")
    if starts > 1:
        lines.insert(0, f"{starts} starts of the autopilot in it, each by its own clock")
    numbers = [] if store is None else _keep(store, path.name, found)
    lines += [f"kept as flight {number}: companion history lists it" for number in numbers]
    answer = {"state": "done", "reason": "", "file": str(path), "numbers": numbers}
    answer["flights"] = msgspec.to_builtins(found)
    return conclude(options, answer, lines, good=True)


def _knowledge(options: argparse.Namespace) -> tuple[Knowledge, FlightStore | None]:
    """Read what the companion has on disk, and give its store of flights; None: this user may not."""
    from companion.storage.learned import BiasStore
    from companion.storage.records import FlightStore, RecordStore

    directory = storage_path(options)
    try:
        known = RecordStore(directory).history(), BiasStore(directory).all()
    except StorageError as error:
        words = "looked at without the companion's history, and not kept; sudo may help"
        print_lines(f"note: {error}: {words}", error=True)
        return ((), {}), None
    return known, FlightStore(directory)


def _keep(store: FlightStore, log: str, found: Sequence[Flight]) -> list[int]:
    """Keep the flights that flew, for the history; return their numbers."""
    read_at = datetime.datetime.now(tz=datetime.UTC).isoformat(timespec="seconds")
    flown = [each for each in found if any(imu.drift for imu in each.imus)]
    if flown and not store.folder.parent.is_dir():
        where = f"this computer has no companion's storage ({store.folder.parent})"
        print_lines(f"note: not kept: {where}; on the companion flights are kept for the history", error=True)
        return []
    try:
        return [store.save(KeptFlight(log=log, read_at=read_at, flight=each)) for each in flown]
    except StorageError as error:
        print_lines(f"note: not kept: {error}", error=True)
        return []


def _flight_lines(number: int, found: Flight) -> list[str]:
    stages = found.stages
    when = f"flight of {found.began_at}" if found.began_at else "flight at an unknown time"
    start = f"{when}: armed {stages.armed_s:.0f} s after start {number} of the autopilot"
    told = [
        f"{what} {at_s - stages.armed_s:.0f} s"
        for what, at_s in (
            ("motors", stages.motors_s), ("take-off", stages.take_off_s), ("landing", stages.landing_s),
            ("disarmed", stages.disarmed_s),
        )
        if at_s is not None
    ]  # fmt: skip
    lines = [start, f"  after arming: {', '.join(told) or 'nothing more is logged'}"]
    if found.reference == "truth":
        lines.append("  measured from the simulator's truth, not from the EKF")
    lines += [f"  note: {note}" for note in found.notes]
    for imu in found.imus:
        lines += _imu_lines(imu)
    if any(axis.in_flight for imu in found.imus for axis in imu.axes):
        lines += ["left over: bias that the offsets did not take off, ± one sigma (docs/flight.md)", f"  {UNSEEN}"]
    return [*lines, *([f"next flight: {next_flight(found)}"] if any(imu.drift for imu in found.imus) else [])]


def _imu_lines(imu: ImuFlight) -> list[str]:
    whose = (
        f"offsets of the calibration of {imu.calibration}"
        if imu.calibration
        else "offsets of no calibration known here"
    )
    lines = [f"IMU {imu.imu}, {imu.rate_hz:.0f} Hz: {whose}"]
    lines += [f"  note: {note}" for note in imu.notes]
    lines += [f"  {words}" for words in drift_lines(imu)]
    if any(axis.in_flight for axis in imu.axes):
        lines += [f"  {words}" for words in _table(imu)]
    return lines


def _table(imu: ImuFlight) -> list[str]:
    """Make the table of axes; name once what is known of none."""
    shown = [term for term in HEADS if any(getattr(axis, term) for axis in imu.axes)]
    lines = [f"{'left over':13}" + "".join(f"{HEADS[term]:>13}" for term in shown)]
    for axis in imu.axes:
        unit, name, digits = unit_of(axis.axis)
        terms = [_term(getattr(axis, term), unit, digits) for term in shown]
        lines.append(f"{', '.join((axis.axis, name)):13}" + "".join(f"{each:>13}" for each in terms))
    if lacking := [head for term, head in HEADS.items() if term not in shown]:
        lines.append(f"not known: {', '.join(lacking)}")
    return lines


def _term(term: Term | None, unit: float, digits: int) -> str:
    if term is None:
        return "?"
    # Adding zero leaves no minus sign before a zero.
    return f"{round(term.value / unit, digits) + 0.0:+.{digits}f} ± {term.sigma / unit:.{digits}f}"

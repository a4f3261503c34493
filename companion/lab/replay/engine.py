"""A recording through the daemon's decoders, collector and estimator, in the recorded order and at the recorded times.

Recomputed: every sample from its raw bytes, every batch, verdict of stillness and mean, pose, biases and sigmas. Taken
from the recording: the times of ticks and windows, the parameters in force in the autopilot, the place, what earlier
power-ups had told, and all that only the autopilot can tell: what was written and read back, with which outcome.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import msgspec

from companion.configured import models
from companion.configured.models import collect
from companion.errors import StorageError
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.records.record import Record, from_json
from companion.lab.logs.playback import UNUSABLE, Playback, config_of
from companion.lab.logs.recording import Head, Message, Recording
from companion.lab.replay.calibrations import Calibrations, Offsets, Replayed
from companion.recording import messages
from companion.recording.files import versions
from companion.recording.messages import ImuState, Start, decode

FOLLOWS_S: Final = 3.0
"""The longest gap between two files that follow on one another: more means that one between them is missing."""


class Result(msgspec.Struct, frozen=True):
    """What a recording gave."""

    calibrations: list[Replayed]
    estimate: Record | None
    """Of the last still stretch, where no calibration is in the recording."""
    seconds: float
    cut_short: str | None
    notes: list[str]
    """What a reader should know: other versions, gaps."""


class Replay:
    """One pass over a recording: one file, or several of a ring, the oldest first."""

    def __init__(self, head: Head, path: Path) -> None:
        config = config_of(head, path)
        self._path, self._config, self._head = path, config, head
        self._playback, self._calibrations = Playback(config), Calibrations(config)
        self._collector: RollingCollector | None = None
        self._notes: list[str] = []
        self._is_cut = False
        self._first_s = self._now_s = math.nan

    def take(self, message: Message) -> None:
        """Take the next message.

        Raises:
            StorageError: it is nothing that this version could have written.
        """
        try:
            self._take(message.topic, message.data, message.t_s)
        except UNUSABLE as error:
            raise StorageError(
                f"{self._path}: a message on {message.topic} cannot be used by this version ({error})"
            ) from None

    def _take(self, topic: str, data: bytes, t_s: float) -> None:
        if topic == messages.START:
            self._start(decode(topic, data), t_s)
        collector = self._collector
        if collector is None:
            return
        self._now_s = t_s
        if self._playback.wants(topic):
            before = self._imu_state(topic)
            for role, part in self._playback.take(topic, data, t_s):
                collect(collector, role, part)
            if (state := self._imu_state(topic)) is not None:
                _change(collector, before, state)
        elif topic == messages.TICK:
            collector.tick(t_s)
        elif topic == messages.PLACE:
            self._calibrations.where = decode(topic, data)
        elif topic == messages.MEASURED:
            self._calibrations.measured(collector, decode(topic, data), t_s, self._offsets())
        elif topic == messages.SOLVED:
            self._calibrations.solve(decode(topic, data))
        elif topic == messages.RECORD:
            self._calibrations.recorded(from_json(data))

    def _start(self, start: Start, t_s: float) -> None:
        follows = start.continues and self._collector is not None and not self._is_cut
        if follows and t_s - self._now_s < FOLLOWS_S:
            return
        if start.lost:
            self._notes.append(f"{start.lost} messages were lost in recording; replayed from behind the gap")
        if math.isnan(self._first_s):
            self._first_s = t_s
        self._is_cut = False
        self._collector = models.collector(self._config)
        self._playback.begin()
        self._calibrations.begin(t_s)

    def _imu_state(self, topic: str) -> ImuState | None:
        return self._playback.state(topic.removeprefix(messages.IMU)) if topic.startswith(messages.IMU) else None

    def _offsets(self) -> Offsets:
        states = {imu.name: self._playback.state(imu.name) for imu in self._config.imu}
        return {name: state.calibration for name, state in states.items() if state is not None}

    def cut(self) -> None:
        """Note that the end of a file is missing: the next one begins anew."""
        self._is_cut = True

    def goes_on(self, head: Head) -> bool:
        """Return whether a file with this head is of the same run of the daemon."""
        return (head.offset_ns, head.config) == (self._head.offset_ns, self._head.config)

    def result(self, cut_short: str | None) -> Result:
        """Return what it gave."""
        seconds = 0.0 if math.isnan(self._first_s) else self._now_s - self._first_s
        estimate = None
        if not self._calibrations.again and self._collector is not None:
            began_s = self._first_s + self._head.offset_ns / 1e9
            began_at = datetime.datetime.fromtimestamp(began_s, tz=datetime.UTC)
            self._calibrations.set_offsets(self._offsets())
            estimate = self._calibrations.estimate(self._collector, self._now_s, began_at, seconds)
        ours, theirs = versions(), self._head.versions
        notes = []
        if ours["companion"] != theirs.get("companion"):
            notes.append(f"recorded with companion {theirs.get('companion')}, here {ours['companion']}")
        return Result(self._calibrations.again, estimate, seconds, cut_short, [*notes, *self._notes])


def _change(collector: RollingCollector, before: ImuState | None, state: ImuState) -> None:
    """Tell the collector of another stream or other offsets, as the daemon does."""
    name = state.input.name
    if before is None or messages.encode(before.input) != messages.encode(state.input):
        collector.set_imu(state.input)
    one, other = None if before is None else before.calibration, state.calibration
    if one is None or other is None:
        if one is not other:
            collector.reset("offsets written", name)
    elif not one.corrects_like(other):
        collector.reset("offsets written", name)


def replay(paths: Iterable[Path]) -> Result:
    """Replay recordings in this order, each to its end or to where it is cut.

    Raises:
        StorageError: one line: a file is none of ours, or was made by another version.
    """
    found: Replay | None = None
    cut_short: str | None = None
    for path in paths:
        recording = Recording(path)
        for item in recording.items():
            if isinstance(item, Message):
                if found is not None:
                    found.take(item)
            elif found is None:
                found = Replay(item, path)
            elif not found.goes_on(item):
                raise StorageError(f"{path}: not of the same run of the daemon as the file before; replay it alone")
        if recording.cut_short is not None and found is not None:
            cut_short = cut_short or recording.cut_short
            found.cut()
    assert found is not None
    return found.result(cut_short)

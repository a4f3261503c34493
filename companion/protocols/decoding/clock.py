"""Times of samples on the host's clock, by a device's own clock and its counter.

A read comes late by the line, a USB adapter, or a busy host. The offset between the two clocks is the running minimum
of (read - device), which may creep upwards as two crystals drift apart: causal, and immune to stalls (sensors 4.4).
A clock that went back or fell behind belongs to a device that restarted; one that jumped forward to another device,
or the host slept. Either way it is mapped afresh.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Final

import msgspec

from companion.samples import ImuSample, Sample

CREEP: Final = 100e-6
"""Rate at which the minimum may rise: two crystals of 50 ppm. A ceramic resonator is followed in steps of `STEP_S`."""

STEP_S: Final = 0.005
"""When all samples of a `SPAN_S` came later than this, the offset itself has changed."""
SPAN_S: Final = 1.0
SPAN_SAMPLES: Final = 20  # the fewest samples in a span: of a few all may have had to wait for the adapter

LATE_S: Final = 1.0
"""A sample that seems later than this is dropped: too old to be of use, or its clock is wrong."""

_WRAP_S: Final = 2.0
_WRAP_SHARE: Final = 0.01
"""A clock that wraps has advanced as the host's has, but for a stall and for what the two differ by."""
LATE: Final = "late"


class DeviceClock:
    """Maps one device's clock to the host's; it starts again at 0 after `wraps_s`, by its format, or never."""

    def __init__(self, wraps_s: float | None) -> None:
        self.breaks = 0  # samples before and after a break need not be from one device without a pause
        self.device_s = 0.0  # The clock as of the last sample, unwrapped
        self._wraps_s = wraps_s
        self._raw_s = self._arrival_s = self._offset_s = math.nan
        self._new_span(math.nan)

    def _new_span(self, arrival_s: float) -> None:
        self._span_end_s = arrival_s + SPAN_S
        self._least_s = math.inf
        self._seen = 0

    def _start(self, raw_s: float, arrival_s: float) -> float:
        self.device_s = self._raw_s = raw_s
        self._arrival_s = arrival_s
        self._offset_s = arrival_s - raw_s
        self._new_span(arrival_s)
        return arrival_s

    def remap(self) -> None:
        """Forget the offset: the times at which samples arrived so far were wrong."""
        self._offset_s = math.nan

    def host_s(self, raw_s: float, arrival_s: float) -> float | None:
        """Return the host's time of a finite device time, at most `arrival_s`; None for a sample that is too late.

        That lasts while samples come `LATE_S` or more after their time: at most `SPAN_S` when the clock has changed,
        else until a backlog is read.
        """
        if math.isnan(self._offset_s):
            return self._start(raw_s, arrival_s)
        elapsed_s = arrival_s - self._arrival_s
        advance_s = raw_s - self._raw_s
        if advance_s < 0.0 or elapsed_s - advance_s > LATE_S:
            advance_s = self._unwrapped(advance_s, elapsed_s)
        if advance_s < 0.0:
            self.breaks += 1
            return self._start(raw_s, arrival_s)
        self.device_s += advance_s
        self._raw_s, self._arrival_s = raw_s, arrival_s
        self._offset_s += CREEP * advance_s
        delay_s = arrival_s - self.device_s - self._offset_s
        if delay_s < 0.0:
            self.breaks += delay_s < -LATE_S
            self._offset_s += delay_s
            delay_s = 0.0
        self._least_s = min(self._least_s, delay_s)
        self._seen += 1
        if arrival_s >= self._span_end_s and self._seen >= SPAN_SAMPLES:
            delay_s -= self._step(arrival_s)
        return None if delay_s > LATE_S else arrival_s - delay_s

    def _unwrapped(self, advance_s: float, elapsed_s: float) -> float:
        if self._wraps_s is None:
            return advance_s
        turns = round((elapsed_s - advance_s) / self._wraps_s)
        if turns > 0:
            unwrapped_s = advance_s + turns * self._wraps_s
            if unwrapped_s >= 0.0 and abs(unwrapped_s - elapsed_s) <= _WRAP_S + _WRAP_SHARE * elapsed_s:
                return unwrapped_s
        return advance_s

    def _step(self, arrival_s: float) -> float:
        least_s = self._least_s
        self._new_span(arrival_s)
        if least_s <= STEP_S:
            return 0.0
        self._offset_s += least_s
        self.breaks += least_s > LATE_S
        return least_s


class SampleTimes:
    """Gives the samples of one device their times, and unwraps its counter."""

    def __init__(self, clock_wraps_s: float | None = None, sequence_modulus: int | None = None) -> None:
        self.clock = DeviceClock(clock_wraps_s)
        self.dropped: Counter[str] = Counter()
        self._modulus = sequence_modulus
        self._raw_sequence: int | None = None
        self._sequence = 0
        self._newest_s = -math.inf

    def place(self, samples: list[Sample], read_s: float, frame_s: float = 0.0) -> list[Sample]:
        """Place the samples of one feed, timed at their frame's last byte; `frame_s`: line time of a frame."""
        placed: list[Sample] = []
        frame_at_s, frame_t_s = math.nan, math.nan
        clock = self.clock
        for sample in samples:
            at_s = sample.t_s
            if isinstance(sample, ImuSample):
                raw_s, sequence, before = sample.t_device_s, sample.sequence, clock.breaks
                t_s: float | None = at_s - frame_s
                device_s: float | None = None
                if raw_s is not None and math.isfinite(raw_s):
                    t_s, device_s = clock.host_s(raw_s, at_s - frame_s), clock.device_s
                if sequence is not None:
                    sequence = self._counted(sequence, anew=clock.breaks > before)
                if t_s is None:
                    self.dropped[LATE] += 1
                    continue
                t_s = self._in_order(t_s, read_s)
                gyro, accel, warm = sample.gyro_rad_s, sample.accel_m_s2, sample.temperature_degc
                placed.append(ImuSample(t_s, gyro, accel, warm, sequence, device_s, clock.breaks))
                # Whatever else the same frame brought was taken at the same time.
                frame_at_s, frame_t_s = at_s, t_s
            else:
                t_s = frame_t_s if at_s == frame_at_s else self._in_order(at_s - frame_s, read_s)
                placed.append(msgspec.structs.replace(sample, t_s=t_s))
        return placed

    def _in_order(self, t_s: float, read_s: float) -> float:
        """Keep times ascending: bytes that came faster than their line time would go back."""
        if t_s < self._newest_s <= read_s:
            return self._newest_s
        self._newest_s = t_s
        return t_s

    def _counted(self, raw: int, *, anew: bool) -> int:
        """Unwrap the counter; one that went back counts on by one, so that nothing seems lost."""
        last, self._raw_sequence = self._raw_sequence, raw
        if last is None:
            self._sequence = raw
        elif self._modulus is None:
            self._sequence += raw - last if raw >= last else 1
        else:
            step = (raw - last) % self._modulus
            self._sequence += 1 if anew or step > self._modulus // 2 else step
        return self._sequence

"""Times of samples on the host's clock, from a device's own clock and its counter.

A read is delayed by the line, a USB adapter, or a busy host. So the offset between the two clocks is the running
minimum of (read time - device time). The minimum may creep upwards, because two crystals drift apart. This estimate is
causal and immune to stalls (docs/reference/sensors 4.4). If the device's clock went back or fell behind, the device has
restarted. If it jumped forward, the device was replaced or the host slept. In all cases the offset is measured anew.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Final

import msgspec

from companion.samples import ImuSample, Sample

CREEP: Final = 100e-6
"""Largest drift of the device's clock against the host's, s/s: two crystals of 50 ppm. Resonators: see `STEP_S`."""

STEP_S: Final = 0.005
"""Delay, s. If all samples within `SPAN_S` are delayed by more, the offset between the clocks itself has changed."""
SPAN_S: Final = 1.0
SPAN_SAMPLES: Final = 20  # fewest samples in a span: a USB adapter may delay all of a smaller number

LATE_S: Final = 1.0
"""Largest delay of a sample, s; a later sample is dropped, because it is too old or its clock is wrong."""

_WRAP_S: Final = 2.0
_WRAP_SHARE: Final = 0.01
"""At a wrap, the times elapsed on the two clocks may differ by this share, plus `_WRAP_S` for a stall of the host."""
LATE: Final = "late"


class DeviceClock:
    """Conversion of one device's clock to the host's. The device's clock wraps to 0 after `wraps_s`; None: never."""

    def __init__(self, wraps_s: float | None) -> None:
        self.breaks = 0  # number of breaks: restarts, replacements or pauses of the device
        self.device_s = 0.0  # Device time of the last sample, unwrapped
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
        """Discard the offset between the clocks, because the arrival times of earlier samples were wrong."""
        self._offset_s = math.nan

    def host_s(self, raw_s: float, arrival_s: float) -> float | None:
        """Convert a finite device time to host time, at most `arrival_s`; None for a sample later than `LATE_S`.

        After a change of the device's clock, None is returned for at most `SPAN_S`; after a stall, until the backlog
        has been read.
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
    """Assigns host times and unwrapped counter values to the samples of one device."""

    def __init__(self, clock_wraps_s: float | None = None, sequence_modulus: int | None = None) -> None:
        self.clock = DeviceClock(clock_wraps_s)
        self.dropped: Counter[str] = Counter()
        self._modulus = sequence_modulus
        self._raw_sequence: int | None = None
        self._sequence = 0
        self._newest_s = -math.inf

    def place(self, samples: list[Sample], read_s: float, frame_s: float = 0.0) -> list[Sample]:
        """Return samples with host times; `frame_s`, the line time of a whole frame, is subtracted from each time."""
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
                # Other samples of the same frame have the same time.
                frame_at_s, frame_t_s = at_s, t_s
            else:
                t_s = frame_t_s if at_s == frame_at_s else self._in_order(at_s - frame_s, read_s)
                placed.append(msgspec.structs.replace(sample, t_s=t_s))
        return placed

    def _in_order(self, t_s: float, read_s: float) -> float:
        """Keep times ascending: bytes that arrive faster than their line time would give earlier times."""
        if t_s < self._newest_s <= read_s:
            return self._newest_s
        self._newest_s = t_s
        return t_s

    def _counted(self, raw: int, *, anew: bool) -> int:
        """Unwrap the counter. After a step back continue with the next number, so that no sample seems lost."""
        last, self._raw_sequence = self._raw_sequence, raw
        if last is None:
            self._sequence = raw
        elif self._modulus is None:
            self._sequence += raw - last if raw >= last else 1
        else:
            step = (raw - last) % self._modulus
            self._sequence += 1 if anew or step > self._modulus // 2 else step
        return self._sequence

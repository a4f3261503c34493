"""Base class of the ArduPilot double: sensors, estimator, parameters and texts."""

from __future__ import annotations

import abc
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, Protocol

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.ardupilot.estimator import CoarseEstimator
from sim.ardupilot.inertial import Calibrations, InertialPath, orientation_matrix
from sim.ardupilot.parameters import (
    COMPASS_IDS,
    COMPASS_SLOTS,
    NEWEST,
    REAL32,
    ArduPilotParameters,
    Version,
    compass_external_name,
    compass_names,
    default_parameters,
    since,
)
from sim.earth import Array
from sim.firmware.channel import Channel, Stream
from sim.firmware.compass import SimCompass, corrected
from sim.firmware.double import AutopilotDouble
from sim.imu_model import Bias, ImuModel

_COMPASS_SCALES = (1.0 / 1.5, 1.5)
"""Range of a COMPASS_SCALE that is used (`AP_Compass_config.h`)."""
LOOP_RATE_HZ = {"copter": 400.0, "plane": 50.0}


class YawSource(Protocol):
    """An external attitude estimate, as the messages need it."""

    @property
    def selected(self) -> bool:
        """True: the estimator takes its heading from this source."""

    @property
    def aligned(self) -> bool:
        """True: the filter has accepted a heading from this source."""

    def choose(self, source_set: int) -> None:
        """Select a set of sources, 1 to 3."""


class ArduPilotBoard(AutopilotDouble):
    """An ArduPilot without its servers for parameters and commands.

    Args:
        aircraft: the truth.
        imus: one to three models; the first is IMU 1. Their `mounting_deg` is the true orientation of the board, which
            AHRS_ORIENTATION (default none) is meant to undo.
        compasses: one to three, numbered as their parameters; the order in messages is that of COMPASS_PRIOn_ID.
        version: "4.3" to "4.8"; `sim.ardupilot.parameters` has the differences.
        vehicle: "copter" (loop 400 Hz) or "plane" (50 Hz: nothing above 40 Hz).
        parameters: values that differ from the defaults, such as {"INS_GYR_CAL": 0}; set before the first boot.
        up_s: time since the autopilot's boot at the beginning of the simulation.
        auxiliary: the board has parameters of IMU 4 and 5, and a gyro behind 4 that no message shows.
        script: companion_arming.lua runs on the autopilot; only the script's IMU readings in floats are modelled.
    """

    external_nav: YawSource

    def __init__(
        self,
        aircraft: VirtualAircraft,
        imus: Sequence[ImuModel],
        *,
        compasses: Sequence[SimCompass] | None = None,
        system_id: int = 1,
        version: Version = NEWEST,
        vehicle: Literal["copter", "plane"] = "copter",
        parameters: Mapping[str, float] | None = None,
        up_s: float = 30.0,
        auxiliary: bool = False,
        script: bool = False,
        seed: int = 0,
    ) -> None:
        if not 1 <= len(imus) <= 3:
            raise ValueError(f"imus: found {len(imus)}; allowed: 1 to 3")
        channels = (ArduPilotChannel(system_id, self._handle), ArduPilotChannel(system_id, self._handle))
        super().__init__(
            aircraft,
            imus,
            channels,
            compasses=compasses,
            up_s=up_s,
            seed=seed,
            tunes_go_on=False,
        )
        self.system_id, self.version, self.vehicle = system_id, version, vehicle
        self.script = script
        self.parameters = self._new_store(parameters or {}, auxiliary=auxiliary)
        self.estimator = CoarseEstimator()
        self.calibrates_compass = False
        self.airspeed_m_s = 0.0
        """Airspeed in the message VFR_HUD."""
        self._paths = [InertialPath(model, number + 1, self.parameters, seed=seed) for number, model in enumerate(imus)]
        self.calibrations = Calibrations(self._paths, self.parameters, self.random)
        self._frozen: dict[int, Array] = {}
        self.boot_compasses()

    def exchange_imu(self, model: ImuModel, device_id: int) -> None:
        """Replace the sensor of IMU 1: its id comes with the restart, the offsets stay (`register_accel`)."""
        self._paths[0] = InertialPath(model, 1, self.parameters, seed=device_id)
        for half in ("GYR", "ACC"):
            self.parameters.set(f"INS_{half}_ID", device_id)
        self.reboot()

    def residual(self, instance: int, loop_s: float) -> Bias:
        """Error left in the output of IMU `instance` (1..3) after offsets and scales: output minus truth, FRD."""
        t_s = self.aircraft.time_at(loop_s)
        output, truth = self._paths[instance - 1].corrected(t_s, armed=self.armed), self.aircraft.truth_at(t_s)
        return Bias(output[:3] - truth.rate_rad_s, output[3:] - truth.force_m_s2)

    @property
    def has_highres_imu(self) -> bool:
        """True if the firmware has HIGHRES_IMU: version 4.6 or later, on boards with more than 1 MB of flash."""
        return since(self.version, "4.6") and not self.faults.int_only

    @property
    def fastest_interval_ms(self) -> int:
        """Shortest interval of a stream: 1.25 loop periods, in whole milliseconds."""
        return int(1.25 * 1000.0 / LOOP_RATE_HZ[self.vehicle])

    def imu_output(self, index: int, loop_s: float) -> Array:
        """Return filtered rates and specific forces (6) of IMU index 0..2 in vehicle FRD."""
        if self.faults.frozen_imu and index in self._frozen:
            return self._frozen[index]
        output = self._paths[index].output(self.aircraft.time_at(loop_s), armed=self.armed)
        self._frozen[index] = output
        return output

    def boot_compasses(self) -> None:
        """Connect each compass to its slot of parameters, in the order of COMPASS_PRIOn_ID; a boot reads both."""
        stored = self.parameters.values
        ids = COMPASS_IDS[: len(self.compasses)] if stored["COMPASS_ENABLE"] else ()
        slots = {stored[f"COMPASS_DEV_ID{slot}"]: slot for slot in COMPASS_SLOTS}
        order = (stored[f"COMPASS_PRIO{number}_ID"] for number in (1, 2, 3))
        self.compass_slots = [(ids.index(own), slots[own]) for own in order if own in ids and own in slots]
        """Number (0..) and slot ("", "2", "3") of each compass, by priority."""

    def compass_correction(self, slot: str) -> tuple[Array, Array, Array]:
        """Return offsets, milligauss, diagonal, and elements beside it (3,) of a slot."""
        offset, diagonal, beside = (self.parameters.vector(compass_names(slot, what)) for what in ("OFS", "DIA", "ODI"))
        return np.array(offset), np.array(diagonal), np.array(beside)

    def compass_field(self, priority: int, t_s: float) -> Array:
        """Return the corrected field (3,) in vehicle FRD, milligauss, of the compass of this priority; none: zero."""
        if priority >= len(self.compass_slots):
            return np.zeros(3)
        number, slot = self.compass_slots[priority]
        reading, used = self.compass_reading(number, t_s), self.parameters.effective
        if not reading.any():
            return reading
        mounting = f"COMPASS_ORIENT{slot}" if used[compass_external_name(slot)] else "AHRS_ORIENTATION"
        raw, scale = orientation_matrix(self.parameters, mounting) @ reading, used[f"COMPASS_SCALE{slot}"]
        scale = scale if _COMPASS_SCALES[0] <= scale <= _COMPASS_SCALES[1] else 1.0
        return scale * corrected(raw, *self.compass_correction(slot))

    def update_estimator(self, loop_s: float) -> None:
        """Advance the estimator to this time; call it before anything changes the output."""
        error = self.residual(1, loop_s)
        self.estimator.update(self.aircraft.time_at(loop_s), error.gyro_rad_s, error.accel_m_s2)

    def answer_delay_s(self) -> float:
        """Return the delay of a PARAM_VALUE: 2 to 6 ms, on Plane 17 to 23 ms."""
        low, high = (0.002, 0.006) if self.vehicle == "copter" else (0.017, 0.023)
        return float(self.random.uniform(low, high))

    def read_delay_s(self) -> float:
        """Return the delay of the answer to a parameter read, which waits for a slow thread: 5 to 95 ms."""
        return float(self.random.uniform(0.005, 0.095))

    @abc.abstractmethod
    def announce(self, names: Iterable[str]) -> None:
        """Send PARAM_VALUE on every port for values that the autopilot itself has changed and saved."""

    def say(self, severity: int, text: str) -> None:
        """Send STATUSTEXT on every port, in chunks of 50 characters."""
        data = text.encode()
        chunks = [data[start : start + 50] for start in range(0, len(data), 50)]
        text_id = int(self.random.integers(1, 65536)) if len(chunks) > 1 else 0
        for channel in self.channels:
            for number, chunk in enumerate(chunks):
                self.answer(channel, mavlink.MAVLink_statustext_message(severity, chunk, text_id, number))

    def _new_store(self, overrides: Mapping[str, float], *, auxiliary: bool) -> ArduPilotParameters:
        table = default_parameters(
            self.version, len(self.imus), [one.external for one in self.compasses], auxiliary=auxiliary
        )
        own = "MAV_SYSID" if since(self.version, "4.7") else "SYSID_THISMAV"
        table[own] = (float(self.system_id), table[own][1])
        table["SCHED_LOOP_RATE"] = (LOOP_RATE_HZ[self.vehicle], table["SCHED_LOOP_RATE"][1])
        # Names of a later firmware (pull request 32471) exist only where a value is given.
        table |= {name: (0.0, REAL32) for name in overrides if name.endswith("VRFB_Z")}
        store = ArduPilotParameters(table)
        for name, value in overrides.items():
            store.set(name, value)
        return store


MAX_INTERVALS = 10
"""Number of different stream intervals per port, besides the heartbeat's; a further stream gets the nearest of them."""


class ArduPilotChannel(Channel):
    """A port: ten intervals, and a quarter of the stream rates during a parameter list."""

    def set_stream(self, message_id: int, interval_s: float | None, now_s: float) -> None:
        """Start, change or (None) stop a stream; after ten different intervals, a stream gets the nearest of these."""
        if interval_s is None:
            self.streams.pop(message_id, None)
            return
        apart = (message_id, mavlink.MAVLINK_MSG_ID_HEARTBEAT)
        kept = {stream.interval_s for other, stream in self.streams.items() if other not in apart}
        if message_id != mavlink.MAVLINK_MSG_ID_HEARTBEAT and interval_s not in kept and len(kept) >= MAX_INTERVALS:
            wanted_s = interval_s
            interval_s = min(kept, key=lambda value: abs(value - wanted_s))
        self.streams[message_id] = Stream(interval_s, now_s + interval_s)

    def due(self, now_s: float) -> list[int]:
        """Return the ids of messages that are due; a stream that is late skips messages and never sends a burst."""
        due = []
        for message_id, stream in self.streams.items():
            if stream.next_s <= now_s + 1e-9:
                due.append(message_id)
                slow = self.listing and message_id != mavlink.MAVLINK_MSG_ID_HEARTBEAT
                interval = stream.interval_s * (4.0 if slow else 1.0)
                stream.next_s += interval
                if stream.next_s <= now_s:
                    stream.next_s = now_s + interval
        return due

"""Stored results of alignments: the gradienter's zero, six-position results of accelerometers, and the history."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Mapping

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.parameters.change import same_float32
from companion.component.service import JobResult
from companion.config.sections import Config
from companion.configured import models
from companion.daemon.core import Core, Offload
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.errors import StorageError
from companion.estimation.alignment.faces import BIAS, FIGURES, SCALE, SHEAR, Sides
from companion.estimation.means.pose import GradienterModel
from companion.estimation.means.windows import Window
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.align_record import (
    AlignmentRecord,
    CompassRecord,
    FacesImuRecord,
    FacesRecord,
    GradienterSettings,
    Running,
    TurnRecord,
)
from companion.estimation.records.record import AlignmentUsed
from companion.estimation.solution.truth import aged_m_s2
from companion.formats import Object, utc_now
from companion.links.system.events import Listeners
from companion.messages import message
from companion.physics.units import MG
from companion.storage.changes import PREDICTION
from companion.storage.records import KEEP_DONE, Done, alignment_in, alignments_in, faces_in, this_boot

logger = logging.getLogger(__name__)


class ActiveAlignment:
    """Gradienter's measured zero, and the check that it still fits the configuration."""

    def __init__(self, config: Config, offload: Offload) -> None:
        self._gradienter, self._offload = config.gradienter, offload
        self._store = alignment_in(config.storage.path)
        self.record: AlignmentRecord | None = None
        self.unused: str | None = None
        self.doubt: str | None = None  # Reason why the last alignment found no zero, until the next one or a restart
        self.on_change: Listeners[[]] = Listeners()

    def load(self) -> None:
        self._take(self._store.load())
        if self._store.unusable is not None:
            self.unused = self._store.unusable
        elif self.unused is not None:
            logger.warning("%s", self.warning)

    async def keep(self, record: AlignmentRecord) -> None:
        """Save a new alignment and make it the active one; a StorageError leaves the previous one active."""
        await self._offload(self._store.write, record)
        self._take(record)
        self.on_change.tell()

    async def forget(self) -> bool:
        was = self.record is not None or self.unused is not None
        await self._offload(self._store.clear)
        self._take(None)
        if was:
            self.on_change.tell()
        return was

    def settings(self) -> GradienterSettings | None:
        if self._gradienter is None:
            return None
        return msgspec.convert(self._gradienter, GradienterSettings, from_attributes=True)

    @property
    def used(self) -> AlignmentUsed | None:
        if self.record is None or self.unused is not None:
            return None
        return msgspec.convert(self.record, AlignmentUsed, from_attributes=True)

    def model(self) -> GradienterModel | None:
        return models.aligned(models.gradienter_model(self._gradienter), self.used)

    @property
    def warning(self) -> str | None:
        if self.doubt is not None:
            return message("gradienter_doubted", reason=self.doubt)
        return None if self.unused is None else message("alignment_not_used", reason=self.unused)

    @property
    def contradicted(self) -> bool:
        """True if the gradienter contradicts the IMUs, or has other settings than when its zero was measured."""
        changed = self.record is not None and self.unused is not None and self._gradienter is not None
        return changed or self.doubt is not None

    def status(self) -> dict[str, object] | None:
        if self.record is None and self.unused is None:
            return None
        kept = {key: getattr(self.record, key, None) for key in ("kind", "measured_at", "offset_deg", "sigma_deg")}
        return {"in_force": self.used is not None, "unused_because": self.unused, **kept}

    def _take(self, record: AlignmentRecord | None) -> None:
        self.record, self.unused, self.doubt = record, None, None
        if record is None:
            return
        if (now := self.settings()) is None:
            self.unused = "no gradienter is configured"
        elif different := [
            key for key in now.__struct_fields__ if getattr(record.gradienter, key) != getattr(now, key)
        ]:
            names = ", ".join(f"gradienter.{key}" for key in different)
            self.unused = f"measured with another {names}: correct it, or align zero"


class ActiveSixPosition:
    """Accelerometer errors from a six-position measurement, converted to the present offsets and scales."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu]) -> None:
        self._store, self._offload = faces_in(core.config.storage.path), core.offload
        self._collector, self._profiles, self._imus = core.collector, core.profiles, imus
        self._host = this_boot()
        self.record: FacesRecord | None = None

    def load(self) -> None:
        self.record = self._store.load()

    async def keep(self, record: FacesRecord) -> None:
        await self._offload(self._store.write, record)
        self.record = record

    def status(self) -> list[Object]:
        if self.record is None:
            return []
        return [
            {
                "name": kept.name,
                "measured_at": self.record.measured_at,
                "temperature_degc": kept.temperature_degc,
                "bias_left_mg": (now.figures[BIAS] / MG).round(4).tolist(),
                "bias_sigma_mg": (now.sigma[BIAS] / MG).round(4).tolist(),
                "scale_left": now.figures[SCALE].round(7).tolist(),
                "scale_sigma": now.sigma[SCALE].round(7).tolist(),
            }
            for kept in self.record.imus
            if (now := self._now(kept.name, kept.temperature_degc)) is not None
        ]

    def running(self, name: str) -> Running | None:
        up_s = self._collector.up_s(name)
        if up_s is None or not self._host:
            return None
        return Running(host=self._host, started_s=asyncio.get_running_loop().time() - up_s, up_s=up_s)

    def sides(self, window: Window) -> dict[str, Sides]:
        found = {imu.name: self._now(imu.name, imu.temperature_degc) for imu in window.imus}
        return {name: now for name, now in found.items() if now is not None}

    def sigma_m_s2(self, name: str, temperature_degc: float | None) -> float | None:
        """Return the largest sigma of the biases of an accelerometer; None if its offsets do not remove them."""
        imus, now = () if self.record is None else self.record.imus, self._now(name, temperature_degc)
        # The sigma at the measurement decides: a power-up widens it beyond what undone offsets leave.
        measured = next((np.array(imu.accel_bias_mg.sigma) * MG for imu in imus if imu.name == name), np.zeros(3))
        if now is None or (np.abs(now.figures[BIAS]) > measured).any():
            return None
        return float(now.sigma[BIAS].max())

    def measured_s(self, name: str) -> float:
        """Return the event-loop time of a measurement; -inf: before the start of the computer."""
        when = next((imu.running for imu in self.record.imus if imu.name == name), None) if self.record else None
        return when.started_s + when.up_s if when is not None and when.host == self._host else -math.inf

    def _now(self, name: str, temperature_degc: float | None) -> Sides | None:
        calibration = self._imus[name].calibration if name in self._imus else None
        return None if calibration is None else self.known(name, calibration, temperature_degc)

    def known(self, name: str, calibration: ImuCalibration, temperature_degc: float | None) -> Sides | None:
        """Return the errors left in an accelerometer's output, in sensor axes; None if they were never measured."""
        imus = () if self.record is None else self.record.imus
        kept = next((imu for imu in imus if imu.name == name), None)
        if kept is None or kept.accel_id != calibration.accel_id:
            return None
        names = calibration.parameters
        if not {*names.accel_offset, *names.accel_scale} <= kept.corrections.keys():
            return None
        # Output = scale (raw - offset), both at the measurement and now.
        offset = np.array([kept.corrections[one] for one in names.accel_offset])
        x, y, z = (kept.corrections[one] for one in names.accel_scale)
        scale, now = calibration.in_use((x, y, z)), calibration.in_use()
        bias, error = np.array(kept.accel_bias_mg.value) * MG, np.array(kept.accel_scale.value)
        right_offset, right_scale = offset + bias / scale, scale / (1.0 + error)
        figures, sigma = np.zeros(FIGURES), np.zeros(FIGURES)
        figures[BIAS] = now * (right_offset - np.array(calibration.accel_offset_m_s2))
        figures[SCALE], figures[SHEAR] = now / right_scale - 1.0, kept.accel_shear.value
        sigma[BIAS] = np.hypot(np.array(kept.accel_bias_mg.sigma) * MG, self._widened_m_s2(kept, temperature_degc))
        sigma[SCALE], sigma[SHEAR] = kept.accel_scale.sigma, kept.accel_shear.sigma
        return Sides(figures, sigma, calibration.orientation)

    def _widened_m_s2(self, kept: FacesImuRecord, temperature_degc: float | None) -> float:
        now, before = self.running(kept.name), kept.running
        gap_s = now.up_s - before.up_s if now is not None and before is not None and before.is_same(now) else None
        degrees = kept.temperature_degc, temperature_degc
        kelvin = None if degrees[0] is None or degrees[1] is None else degrees[1] - degrees[0]
        return aged_m_s2(noise_profile(self._profiles.of(kept.name)).accel, gap_s, kelvin)


class ByHand:
    """History of alignments and the parameters that they wrote, for `companion history` and `status`."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu]) -> None:
        self._file = alignments_in(core.config.storage.path)
        self._vehicle, self._offload, self._imus = core.vehicle, core.offload, imus
        self._done: list[Done] = []

    def load(self) -> None:
        self._done = self._file.read()

    async def keep(self, job: Job, result: JobResult) -> None:
        record = job.product
        if result.outcome == "cancelled" or not isinstance(
            record, AlignmentRecord | FacesRecord | TurnRecord | CompassRecord
        ):
            return
        board = record.board.written if isinstance(record, TurnRecord) and record.board is not None else {}
        parts = [board]
        if isinstance(record, CompassRecord):
            parts += [one.written for one in record.compasses]
        elif not isinstance(record, AlignmentRecord):
            parts += [imu.written for imu in record.imus]
        kept = [(name, one) for part in parts for name, one in part.items() if one.outcome in ("verified", "stored")]
        done = Done(
            what="level" if board else record.kind,
            state=result.outcome,
            measured_at=record.measured_at,
            reason=result.reason.partition("; now: ")[0],
            system_id=self._vehicle.system_id,
            written={name: one.after for name, one in kept},
            heading_sigma_deg={f"compass {one.number}": one.heading_sigma_deg for one in record.compasses}
            if isinstance(record, CompassRecord)
            else {},
        )
        await self._write([*self._done, done][-KEEP_DONE:])

    async def undone(self, measured_at: str) -> None:
        """Note that what was measured at this time was undone, or that its zero was forgotten."""
        now, at = utc_now(), measured_at
        undone = [msgspec.structs.replace(one, undone_at=now) if one.measured_at == at else one for one in self._done]
        await self._write(undone)

    async def _write(self, done: list[Done]) -> None:
        self._done = done
        try:
            await self._offload(self._file.write, done)
        except StorageError as error:
            logger.error("the history does not show it: %s", error)  # noqa: TRY400 - one line

    @property
    def last_compass(self) -> Done | None:
        """Return the last alignment that wrote compasses of this autopilot, unless it was undone."""
        here = [one for one in self._done if one.what == "compass" and one.written and one.undone_at is None]
        return next((one for one in reversed(here) if one.system_id == self._vehicle.system_id), None)

    def history(self) -> list[Object]:
        return [self._shown(done) for done in reversed(self._done)]

    def latest(self) -> list[Object]:
        here = {done.what: done for done in self._done if done.system_id == self._vehicle.system_id}
        here.pop(PREDICTION, None)
        return [self._shown(done) for done in sorted(here.values(), key=self._done.index, reverse=True)]

    def _shown(self, done: Done) -> Object:
        """Return an alignment as an object; `in_force`: whether the autopilot has all its values (None: unknown)."""
        in_force: bool | None = None
        if done.undone_at is not None:
            in_force = False
        elif done.system_id == self._vehicle.system_id:
            known = [imu.calibration.corrections for imu in self._imus.values() if imu.calibration is not None]
            now = {name: value for corrections in known for name, value in corrections.items()}
            seen = [same_float32(now[name], value) for name, value in done.written.items() if name in now]
            in_force = all(seen) if seen else None
        return {**msgspec.to_builtins(done), "in_force": in_force}

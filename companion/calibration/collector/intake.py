"""What comes into the rolling collector: which streams there are, and where each sample goes."""

from __future__ import annotations

from abc import ABC, abstractmethod

from companion.calibration.collector.sources import Source, compass_source, gradienter_source, imu_source
from companion.calibration.means.pose import CompassModel, FieldHeading, GradienterModel
from companion.calibration.means.windows import ImuInput, integer_steps
from companion.calibration.stillness.gates import ImuGate, Verdict
from companion.calibration.stillness.settling import Lag
from companion.samples import CompassSample, ImuSample, MagSample, TiltSample


class Intake(ABC):
    """The streams, and what is known of each. Nothing that a sample holds makes it raise."""

    def __init__(
        self,
        keep: int,
        *,
        gradienter: bool,
        compass: bool,
        lags: tuple[Lag, Lag],
        field_by: tuple[CompassModel, GradienterModel | None] | None,
    ) -> None:
        self._keep = keep
        self._inputs: dict[str, ImuInput] = {}
        self._imus: dict[str, Source] = {}
        self._lags = lags
        self._tilt = gradienter_source(keep, lags[0]) if gradienter else None
        self._heading = compass_source(keep, lags[1]) if compass else None
        self._breaks: dict[str, int] = {}
        self._field = None if field_by is None else FieldHeading(*field_by, keep)

    @abstractmethod
    def _evaluate(self) -> None:
        """A second of some stream has ended: judge what can be judged."""

    @abstractmethod
    def reset(self, why: str, imu: str | None = None) -> None:
        """Forget what was measured, of one IMU or of everything."""

    @abstractmethod
    def _break(self) -> None:
        """The still stretch is over."""

    # ------------------------------------------------------------------------------------------------- samples in

    def add_imu(self, name: str, sample: ImuSample) -> None:
        """Take one sample of the IMU of that name; of an unknown name it is dropped."""
        source = self._imus.get(name)
        if source is None:
            return
        if sample.breaks != self._breaks.get(name, 0):
            self._breaks[name] = sample.breaks
            self._forget(name)
        stamp = sample.sequence if sample.sequence is not None else sample.t_device_s
        row = sample.gyro_rad_s + sample.accel_m_s2
        if source.batches.add(sample.t_s, row, sample.temperature_degc, stamp):
            self._evaluate()

    def add_tilt(self, sample: TiltSample) -> None:
        """Take one reading of the gradienter; dropped when none is expected."""
        if self._field is not None:
            self._field.take_tilt(sample)
        if self._tilt is not None and self._tilt.batches.add(
            sample.t_s, (sample.x_deg, sample.y_deg), sample.temperature_degc
        ):
            self._evaluate()

    def add_compass(self, sample: CompassSample) -> bool:
        """Take one heading of the device's own; whether it is the one that counts (else that from its field does)."""
        counts = self._field is None or self._field.takes_own(sample)
        if counts:
            self._take_heading(sample)
        return counts

    def add_field(self, sample: MagSample) -> CompassSample | None:
        """Take the compass' field; the heading that came of it, where that is the one that counts."""
        if self._heading is None or self._field is None:
            return None
        heading = self._field.take(sample)
        self._heading.hint = self._field.hint
        if heading is not None:
            self._take_heading(heading)
        return heading

    def _take_heading(self, sample: CompassSample) -> None:
        if self._heading is not None and self._heading.batches.add(sample.t_s, (sample.heading_deg,)):
            self._evaluate()

    def set_imu(self, imu: ImuInput) -> None:
        """Add an IMU, or say that its stream is another kind now: all that was learned of it is forgotten."""
        self._inputs[imu.name] = imu
        gate = ImuGate(imu.name, imu.profile, (imu.gyro_step_rad_s, imu.accel_step_m_s2))
        known = self._imus.get(imu.name)
        if known is None:
            known = self._imus[imu.name] = imu_source(imu.name, gate, self._keep)
            known.batches.steps = integer_steps(imu)
            # It has no share in the seconds so far.
            self._break()
        else:
            known.gate = gate
            known.batches.steps = integer_steps(imu)
            self.reset("another stream", imu.name)

    def expect(self, *, gradienter: bool, compass: bool) -> None:
        """Change which pose sensors are waited for, for example when one is found dead; the IMUs' history stays."""
        added = (gradienter and self._tilt is None) or (compass and self._heading is None)
        if gradienter != (self._tilt is not None):
            self._tilt = gradienter_source(self._keep, self._lags[0]) if gradienter else None
        if compass != (self._heading is not None):
            self._heading = compass_source(self._keep, self._lags[1]) if compass else None
        if added:
            self._break()

    def _forget(self, imu: str | None) -> None:
        for source in self._sources():
            if imu is None or (source.kind == "imu" and source.name == imu):
                source.batches.forget()
                source.verdict = Verdict(still=False)
                if isinstance(source.gate, ImuGate):
                    source.gate.forget_level()
        self._break()

    def _sources(self) -> list[Source]:
        return [*self._imus.values(), *(source for source in (self._tilt, self._heading) if source is not None)]

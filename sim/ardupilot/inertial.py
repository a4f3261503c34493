"""Path from the sensor to the autopilot's output: offsets, scales, orientation, 20 Hz filter; its gyro calibration.

    gyro_body  = R_b (raw - warm - GYROFFS)
    accel_body = R_b diag(ACCSCAL) (raw - warm - ACCOFFS)

where `warm` is the correction by the temperature calibration (autopilots 10.1), then a second-order low-pass. Telemetry
shows samples of the filtered value, not means; their noise is therefore the noise of the filter's output (N^2 times 44
Hz at 20 Hz cut-off), whatever the message rate, and correlated over some 20 ms. The filter is carried forward exactly
between messages, so the mean over a long time has the variance N^2/T.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sim.ardupilot.parameters import (
    ArduPilotParameters,
    caltemp_name,
    device_id,
    gyro_id_name,
    offset_names,
    tcal_name,
    tcal_names,
)
from sim.earth import Array, mounting_matrix
from sim.firmware.numbers import rotation_matrix
from sim.imu_model import ImuModel

RAW_RATE_HZ = 1000.0
"""Rate of the sensor's own samples, whose rounding adds white noise."""
ORIENTATION_PERIOD_S = 1.0
_MOVING_STEP_S = 0.0025
_TCAL_REFERENCE_DEGC = 35.0
_DAMPING = math.sqrt(0.5)


def orientation_matrix(store: ArduPilotParameters, name: str = "AHRS_ORIENTATION") -> Array:
    """Return the rotation from board to vehicle for a parameter (101, 102: custom); unknown numbers: none."""
    number = int(store.effective[name])
    if number in (101, 102):
        if not store.effective["CUST_ROT_ENABLE"]:
            return np.eye(3)
        prefix = f"CUST_ROT{number - 100}_"
        return mounting_matrix(*(store.effective[prefix + angle] for angle in ("ROLL", "PITCH", "YAW")))
    return rotation_matrix(number)


class InertialPath:
    """Output of one autopilot IMU. Times are aircraft time, and must not decrease between calls of `reset`."""

    def __init__(self, model: ImuModel, instance: int, store: ArduPilotParameters, *, seed: int) -> None:
        self.model, self.instance = model, instance
        self._store = store
        self._random = np.random.default_rng([seed, 3, instance])
        self._noise: list[Array] = []
        self._noise_key = (0.0, 0.0)
        steps = np.repeat([model.spec.gyro.step, model.spec.accel.step], 3)
        self._density = np.sqrt(model.white**2 + steps**2 / 12.0 / RAW_RATE_HZ)
        self._state = np.zeros((2, 6))
        self._time_s: float | None = None
        self._kernels: dict[tuple[float, float], tuple[Array, Array]] = {}
        self._revision = -1
        self._offset = np.zeros(6)
        self._scale = np.ones(6)
        self._tcal: tuple[float, float, list[Array], Array] | None = None
        self._board = np.eye(3)
        self._board_checked_s = -math.inf

    def reset(self) -> None:
        """Handle a boot: the filter starts again."""
        self._time_s = None
        self._board_checked_s = -math.inf

    def corrected(self, t_s: float, *, armed: bool = False) -> Array:
        """Return the output without noise and filter (6): rates and specific forces in vehicle FRD."""
        return self._correct(self.model.expected(t_s), t_s, armed=armed)

    def output(self, t_s: float, *, armed: bool = False) -> Array:
        """Return the filtered reading at this time (6), in vehicle FRD by the configured orientation."""
        if self._time_s is None:
            self._start(t_s)
        assert self._time_s is not None
        span = t_s - self._time_s
        if span <= 0.0:
            return self._value()
        aircraft = self.model.aircraft
        if aircraft.still_at(t_s) and aircraft.still_at(self._time_s):
            self._advance(self._correct(self.model.expected(t_s)[None], t_s, armed=armed), span)
        else:
            steps = min(math.ceil(span / _MOVING_STEP_S), 400)  # the last second is all that the filter remembers
            begin = max(self._time_s, t_s - steps * _MOVING_STEP_S)
            times = np.linspace(begin, t_s, steps + 1)[1:]
            self._advance(self._correct(self.model.expected_block(times), t_s, armed=armed), (t_s - begin) / steps)
        self._time_s = t_s
        return self._value()

    def _value(self) -> Array:
        value: Array = self._state[0].copy()
        return value

    def _start(self, t_s: float) -> None:
        cutoff = 2.0 * math.pi * self._cutoff_hz()
        sigma = np.outer([1.0, cutoff], self._density) * math.sqrt(cutoff / (4.0 * _DAMPING))
        self._state = sigma * self._random.standard_normal((2, 6))
        self._state[0] += self._correct(self.model.expected(t_s), t_s, armed=False)
        self._time_s = t_s

    def _cutoff_hz(self) -> float:
        return max(self._store.effective["INS_GYRO_FILTER"], 1.0)

    def _correct(self, raw: Array, t_s: float, *, armed: bool) -> Array:
        """Apply the parameters and the temperature at this time to readings (6) or (n, 6)."""
        store = self._store
        if self._revision != store.revision:
            self._revision = store.revision
            self._offset[:3] = store.vector(offset_names(self.instance, "gyro"))
            self._offset[3:] = store.vector(offset_names(self.instance, "accel"))
            self._scale[3:] = store.vector(offset_names(self.instance, "scale"))
            self._tcal = self._read_tcal()
        if not armed and t_s >= self._board_checked_s + ORIENTATION_PERIOD_S:
            self._board = orientation_matrix(store)
            self._board_checked_s = t_s
        board_axes = (raw - self._warm(t_s) - self._offset) * self._scale
        result: Array = (board_axes.reshape(-1, 3) @ self._board.T).reshape(raw.shape)
        return result

    def _warm(self, t_s: float) -> Array:
        """Return the INS_TCALn_* correction (6): zero at CALTEMP, constant beyond TMIN and TMAX."""
        if self._tcal is None:
            return np.zeros(6)
        low, high, coefficients, caltemps = self._tcal
        now = min(max(self.model.temperature_degc(t_s), low), high) - _TCAL_REFERENCE_DEGC
        then = np.clip(caltemps, low, high) - _TCAL_REFERENCE_DEGC
        return np.asarray(sum(each * (now**order - then**order) for order, each in enumerate(coefficients, start=1)))

    def _read_tcal(self) -> tuple[float, float, list[Array], Array] | None:
        """Return TMIN, TMAX, the coefficients of the six axes by order, and the CALTEMPs; None: not enabled."""
        values, number = self._store.effective, self.instance
        if values[tcal_name(number, "ENABLE")] != 1:
            return None
        orders = zip(tcal_names(number, "GYR"), tcal_names(number, "ACC"), strict=True)
        coefficients = [np.array([values[name] for name in (*gyro, *accel)]) * 1e-6 for gyro, accel in orders]
        caltemps = np.repeat([values[caltemp_name(number, "GYR")], values[caltemp_name(number, "ACC")]], 3)
        return values[tcal_name(number, "TMIN")], values[tcal_name(number, "TMAX")], coefficients, caltemps

    def _advance(self, targets: Array, step_s: float) -> None:
        """Let the filter follow targets (n, 6), each of them for `step_s`."""
        key = (round(step_s, 6), self._cutoff_hz())
        transition, root = self._kernel(key)
        if key != self._noise_key:
            self._noise_key, self._noise = key, self._kicks(root, 1)  # a block once the same step has come twice
        follows = np.array([1.0, 0.0]) - transition[:, 0]
        for towards in follows[:, None] * targets[:, None]:
            if not self._noise:
                self._noise = self._kicks(root, 128)
            self._state = transition @ self._state + towards + self._noise.pop()

    def _kicks(self, root: Array, count: int) -> list[Array]:
        return list((root @ self._random.standard_normal((count, 2, 6))) * self._density)

    def _kernel(self, key: tuple[float, float]) -> tuple[Array, Array]:
        """Return transition matrix, and square root of the covariance that unit white noise adds, over a time span."""
        found = self._kernels.get(key)
        if found is None:
            omega = 2.0 * math.pi * key[1]
            decay = omega * _DAMPING  # with this damping the ringing has the same frequency as the decay
            e, c, s = math.exp(-decay * key[0]), math.cos(decay * key[0]), math.sin(decay * key[0])
            transition = e * np.array([[c + s, s / decay], [-(omega**2) * s / decay, c - s]])
            stationary = omega / (4.0 * _DAMPING) * np.diag([1.0, omega**2])
            added = stationary - transition @ stationary @ transition.T
            scale = np.array([1.0, omega])
            low = np.linalg.cholesky(added / np.outer(scale, scale) + 1e-15 * np.eye(2))
            found = (transition, scale[:, None] * low)
            if len(self._kernels) > 256:
                self._kernels.clear()
            self._kernels[key] = found
        return found


GYRO_TIME_S = 0.55
GYRO_GIVES_UP_S = 30.0
AVERAGED_S = 0.5


@dataclass(slots=True)
class Calibrations:
    """Calibrates all IMUs at once. Offsets are in board axes, before scale and orientation."""

    paths: list[InertialPath]
    store: ArduPilotParameters
    random: np.random.Generator
    gyros_ok: bool = True
    """True: the last gyro calibration converged; False prevents arming."""

    def _mean(self, path: InertialPath, t_s: float) -> Array:
        """Return the sensor's mean, with white noise, over the averaging time that ends now."""
        times = np.linspace(t_s - AVERAGED_S, t_s, 21)[1:]
        mean: Array = path.model.expected_block(times).mean(axis=0)
        return mean + self.random.standard_normal(6) * (path.model.white / math.sqrt(AVERAGED_S))

    def clear_gyros(self) -> None:
        """Start a gyro calibration, during which the readings are zero."""
        for path in self.paths:
            for name in offset_names(path.instance, "gyro"):
                self.store.set(name, 0.0)

    def gyros(self, t_s: float, *, converged: bool = True) -> tuple[str, ...]:
        """Store the mean rate, Earth's rotation included, as gyro offset; return the names of the saved parameters.

        Offsets are saved without success too; only the temperature is then not noted. Instances without a gyro are
        zeroed.
        """
        before = dict(self.store.values)
        for path in self.paths:
            mean = self._mean(path, t_s)
            for name, value in zip(offset_names(path.instance, "gyro"), mean[:3], strict=True):
                self.store.set(name, float(value))
            self.store.set(gyro_id_name(path.instance), device_id(path.instance))
            if converged:
                self.store.set(caltemp_name(path.instance, "GYR"), path.model.temperature_degc(t_s))
        for instance in range(len(self.paths) + 1, 6):
            if (auxiliary := instance > 3) and gyro_id_name(instance) not in self.store:
                continue
            fitted = auxiliary and self.store.values[gyro_id_name(instance)] != 0
            for name in offset_names(instance, "gyro"):
                self.store.set(name, float(self.random.normal(0.0, 1e-4)) if fitted else 0.0)
            if not fitted:
                self.store.set(gyro_id_name(instance), 0)
                self.store.set(caltemp_name(instance, "GYR"), -300.0)
        self.gyros_ok = converged
        return tuple(name for name, value in self.store.values.items() if value != before[name])

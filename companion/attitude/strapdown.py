"""Quaternion strapdown: calibrated rates to attitude, and specific force turned along with it.

The frame E that it ends in is fixed to the Earth and near NED; what is left between the two belongs to the leveller
and to the heading. Rotation vectors with two-sample coning, phi_k = a_k + (a_{k-1} x a_k) / 12 (Savage; method section
3, "propagation"). Plain floats: at these sizes they are ten times faster than arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from companion.attitude.quaternion import IDENTITY, Quaternion, Triple, from_rotation_vector, multiply, normalised
from companion.samples import ImuSample

STEP_S: Final = 0.02
"""Length of the stretches over which specific force is averaged for the leveller."""
TURN_S: Final = 0.004
"""Specific force is turned into E after so long at the latest: at 1000 deg/s that is 4 degrees, of which the mean
direction keeps half, for as long as the turn lasts."""
GAP_S: Final = 0.1
"""A longer silence is bridged with the last rate, which then is a guess; it is told as `missing_s`."""
_ROUNDING_S: Final = 1e-6
_ANGLE_SQUARE: Final = 1e6
_FORCE_SQUARE: Final = 1e8
"""Of one sample; ten times what decoders let through, so that nothing overflows here whoever calls."""
LOST_S: Final = 1.0
"""After a longer one the attitude is not known any more."""


class Stretch(NamedTuple):
    """What happened in about `STEP_S` seconds."""

    t_s: float
    """Its end."""
    span_s: float
    force_m_s2: Triple
    """Mean specific force in E."""
    rate_rad_s: Triple
    """Mean rate in the sensor's axes, bias removed."""
    missing_s: float
    """How much of it had no samples."""
    orientation: Quaternion
    """Sensor axes to E at its end."""


class Strapdown:
    """Integrates one IMU's rates, in the sensor's own axes.

    `orientation` takes sensor axes to E; `bias_rad_s` and `force_bias_m_s2` are subtracted from every sample.
    """

    def __init__(self) -> None:
        self.orientation: Quaternion = IDENTITY
        self.bias_rad_s: Triple = (0.0, 0.0, 0.0)
        self.force_bias_m_s2: Triple = (0.0, 0.0, 0.0)
        self.frame_rate_rad_s: Triple = (0.0, 0.0, 0.0)
        """How E turns against inertial space, in E: the Earth's rotation."""
        self.last_s: float | None = None
        self.last_rate_rad_s: Triple = (0.0, 0.0, 0.0)
        self.out_of_order = 0
        """Samples that were not later than the one before: left out."""
        self.implausible = 0
        """Samples that no sensor can mean: left out."""
        self.lost = False
        """Nothing came for longer than `LOST_S`: `orientation` means nothing until it is set again."""
        self._previous: Triple = (0.0, 0.0, 0.0)
        self._clear()

    def restart(self, orientation: Quaternion, t_s: float | None) -> None:
        """Begin anew with this orientation, valid at `t_s`."""
        self.orientation, self.last_s, self.lost = orientation, t_s, False
        self._previous = (0.0, 0.0, 0.0)
        self._clear()

    def _clear(self) -> None:
        self._span_s = 0.0
        self._missing_s = 0.0
        self._angle: Triple = (0.0, 0.0, 0.0)
        self._velocity: Triple = (0.0, 0.0, 0.0)
        self._unturned: Triple = (0.0, 0.0, 0.0)
        self._turn_s = 0.0

    def integrate(self, samples: Sequence[ImuSample]) -> list[Stretch]:
        """Take samples in the order of time; return the stretches that they complete.

        How the samples are cut into calls changes nothing.
        """
        done: list[Stretch] = []
        last_s = self.last_s
        bx, by, bz = self.bias_rad_s
        ex, ey, ez = self.frame_rate_rad_s
        cx, cy, cz = self.force_bias_m_s2
        px, py, pz = self._previous
        w, x, y, z = self.orientation
        span, missing = self._span_s, self._missing_s
        ux, uy, uz = self._angle
        vx, vy, vz = self._velocity
        sx, sy, sz = self._unturned
        turn_s = self._turn_s
        for sample in samples:
            t_s = sample.t_s
            if last_s is None:
                last_s = t_s
                continue
            dt = t_s - last_s
            if not dt > 0.0:
                self.out_of_order += 1
                continue
            last_s = t_s
            if dt > GAP_S:
                missing += dt
                if dt > LOST_S:
                    self.lost = True
                    px = py = pz = 0.0
                    continue
            gx, gy, gz = sample.gyro_rad_s
            fx, fy, fz = sample.accel_m_s2
            ax, ay, az = (gx - bx) * dt, (gy - by) * dt, (gz - bz) * dt
            rx = ax + (py * az - pz * ay) * 0.08333333333333333
            ry = ay + (pz * ax - px * az) * 0.08333333333333333
            rz = az + (px * ay - py * ax) * 0.08333333333333333
            square = rx * rx + ry * ry + rz * rz
            if not (square < _ANGLE_SQUARE and fx * fx + fy * fy + fz * fz < _FORCE_SQUARE):
                self.implausible += 1
                missing += dt
                continue
            px, py, pz = ax, ay, az
            if square < 0.04:
                # cos and half the sinc of the half angle; the next terms are below 2e-9.
                c = 1.0 - square * (0.125 - square * 0.0026041666666666665)
                s = 0.5 - square * (0.020833333333333332 - square * 0.00026041666666666666)
                rx, ry, rz = s * rx, s * ry, s * rz
            else:
                c, rx, ry, rz = from_rotation_vector((rx, ry, rz))
            w, x, y, z = (
                w * c - x * rx - y * ry - z * rz,
                w * rx + x * c + y * rz - z * ry,
                w * ry - x * rz + y * c + z * rx,
                w * rz + x * ry - y * rx + z * c,
            )
            ux += ax
            uy += ay
            uz += az
            sx += (fx - cx) * dt
            sy += (fy - cy) * dt
            sz += (fz - cz) * dt
            turn_s += dt
            span += dt
            if turn_s > TURN_S - _ROUNDING_S:
                # `rotate`, written out: this is the inside of the hottest loop of all.
                tx, ty, tz = 2.0 * (y * sz - z * sy), 2.0 * (z * sx - x * sz), 2.0 * (x * sy - y * sx)
                vx += sx + w * tx + y * tz - z * ty
                vy += sy + w * ty + z * tx - x * tz
                vz += sz + w * tz + x * ty - y * tx
                sx = sy = sz = turn_s = 0.0
                if span > STEP_S - _ROUNDING_S:
                    half = -0.5 * span
                    w, x, y, z = normalised(multiply((1.0, half * ex, half * ey, half * ez), (w, x, y, z)))
                    mean = 1.0 / span
                    force, rate = (vx * mean, vy * mean, vz * mean), (ux * mean, uy * mean, uz * mean)
                    done.append(Stretch(t_s, span, force, rate, missing, (w, x, y, z)))
                    ux = uy = uz = vx = vy = vz = span = missing = 0.0
        self.orientation = (w, x, y, z)
        self.last_s, self._previous = last_s, (px, py, pz)
        self._unturned, self._turn_s = (sx, sy, sz), turn_s
        self._span_s, self._missing_s, self._angle, self._velocity = span, missing, (ux, uy, uz), (vx, vy, vz)
        if samples:
            gx, gy, gz = samples[-1].gyro_rad_s
            self.last_rate_rad_s = (gx - bx, gy - by, gz - bz)
        return done

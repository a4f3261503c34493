"""What each role of a device takes of the samples that its decoder gives.

One device on one port may be IMU, gradienter and compass at once. A decoder gives the tilt of one frame once: as a
`TiltSample`, or as the pitch and roll of its `CompassSample`.
"""

from __future__ import annotations

from companion.protocols.registry import Kind
from companion.samples import CompassSample, ImuSample, Sample, TiltSample

Part = ImuSample | TiltSample | CompassSample


def part_for(role: Kind, sample: Sample) -> Part | None:
    """The sample as this role takes it; None where it has nothing for it."""
    match sample:
        case ImuSample():
            return sample if role == "imu" else None
        case TiltSample():
            return sample if role == "gradienter" else None
        case CompassSample(pitch_deg=pitch_deg, roll_deg=roll_deg):
            if role == "compass":
                return sample
            if role == "gradienter" and pitch_deg is not None and roll_deg is not None:
                return TiltSample(sample.t_s, roll_deg, pitch_deg)
    return None

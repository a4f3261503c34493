"""Words for what the companion says in numbers, and for what is not heard."""

from __future__ import annotations

from typing import Final, Literal

from companion.ground.heard import Heard

RESULTS: Final[dict[float, Literal["done", "failed", "cancelled"] | None]] = {
    0.0: None,
    1.0: "done",
    2.0: "failed",
    3.0: "cancelled",
}
"""CMP_STATE: how the last calibration ended; None: there was none since the companion started."""
AT_ARM: Final = ("off", "warn", "gate")
"""CMP_AT_ARM."""
MEANINGS: Final = {
    "CMP_GYR_TGT": "deg/h: gyro sigma that is good enough",
    "CMP_ACC_TGT": "mg: accelerometer sigma that is good enough",
    "CMP_PUSH": "1: results are written to the autopilot, 0: only measured",
    "CMP_AT_ARM": "0: silent at arming, 1: warns, 2: holds the arming back",
    "CMP_STATE": "last calibration: 0 none, 1 done, 2 failed, 3 cancelled (read only)",
    "CMP_GYR_SIG": "deg/h: gyro sigma of the last result, worst axis (read only)",
    "CMP_ACC_SIG": "mg: accelerometer sigma of the last result, worst axis (read only)",
}


def figures(gyro_deg_h: float | None, accel_mg: float | None) -> str:
    """What a result is worth, in one unit each."""
    gyro = f"sigma {gyro_deg_h:.3g} deg/h" if gyro_deg_h is not None else ""
    accel = f"{'' if gyro else 'sigma '}{accel_mg:.3g} mg" if accel_mg is not None else ""
    return ", ".join(filter(None, (gyro, accel)))


def nobody_heard(heard: Heard, url: str, system_id: int | None, within_s: float) -> str:
    """Why there is nobody to ask, in one line: what was heard, and what to try."""
    others, component = heard.summary(), heard.component_id
    if not others:
        return (
            f"nothing heard on {url} within {within_s:g} s:"
            " is the radio connected, and is this the url (--url) that the vehicle sends to?"
        )
    which = f"of system {system_id} " if system_id is not None else ""
    what = f"no companion (component {component}) {which}heard on {url} within {within_s:g} s, only {others}"
    if "PX4" in others:
        return f"{what}: is `companion run` up, and MAV_1_FORWARD = 1 (then restart the autopilot)?"
    return f"{what}: is `companion run` up, on another port of the autopilot than this link, and forwarded?"

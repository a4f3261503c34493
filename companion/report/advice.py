"""What to do about what a record says: by the words that the companion itself uses."""

from __future__ import annotations

import re
from typing import Final

_ADVICE: Final[tuple[tuple[str, str], ...]] = (
    (r"firmware calibrated all its gyros", "Nothing: this keeps the heading right after a write."),
    (
        r"gradienter has moved by|gradienter's zero differs",
        "Fasten the gradienter, measure its zero (companion align zero), then calibrate again.",
    ),
    (
        r"differ alike from before|differs by .* from|than before: are height|another one now",
        "It contradicts earlier calibrations: see docs/messages.md on that before you fly.",
    ),
    (r"EKF", "Wait 2 minutes, disarmed and still, before take-off, so that the attitude settles."),
    (
        r"no gradienter|need a gradienter|data from gradienter|reading from gradienter",
        (
            "Check the gradienter's cable and power and its section in the configuration (companion check), then"
            " calibrate again: without it only the gyros can be calibrated."
        ),
    ),
    (
        r"no compass|data from compass|reading from compass",
        (
            "Check the compass's cable and its section in the configuration (companion check), then calibrate again."
            " The gyros are usable: the heading matters by up to 15 deg/h."
        ),
    ),
    (
        r"move away from iron|nothing else moved|own heading is|compass field too",
        (
            "Move the aircraft away from cars, steel tables, reinforced concrete and running motors, calibrate again;"
            " if it stays, the compass itself needs its calibration (docs/magnetic.md)."
        ),
    ),
    (
        r"magnetic pole|compass field is vertical",
        "Nothing helps here: the Earth's field is too steep for a compass. The gyros' sigma allows for it.",
    ),
    (
        r"counts_per_gauss|compass field without",
        "Set counts_per_gauss in [compass] from the device's manual, or add a gradienter (docs/magnetic.md).",
    ),
    (
        r"declination|latitude unknown|height unknown",
        (
            "Set latitude_deg, longitude_deg and height_m in [vehicle], or wait for the autopilot's position, then"
            " calibrate again."
        ),
    ),
    (
        r"outside the magnetic model",
        "Check the computer's date; if it is right, the companion is due for an update.",
    ),
    (
        r"warm-up|temperature of imu|K (warmer|colder) than",
        (
            "The sensor is still warming up. Leave everything powered for 10 minutes and calibrate again shortly before"
            " take-off."
        ),
    ),
    (
        r"dither = true|integer steps|integers not spread|distinct readings|coarse steps",
        "The telemetry of this IMU is too coarse. Set push.dither = true, or use IMU 1 where it sends HIGHRES_IMU.",
    ),
    (
        r"lost \d+ ?% of its samples",
        "The link cannot carry the readings: raise the baud rate of the autopilot's port, or unload it.",
    ),
    (
        r"rebooted while|restarted and replaced|is not back, disarmed|Old values NOT back|NOT back",
        (
            "Do not fly before this is settled: wait until the autopilot is heard, disarmed, look at companion status,"
            " and calibrate again."
        ),
    ),
    (
        r"effect of the written offsets not seen|effect was not seen|not seen to work|reboot",
        (
            "The values are stored, but nothing shows that they are in use: restart the autopilot (companion calibrate"
            " --wait --reboot does both) and look at companion status."
        ),
    ),
    (
        r"were not still|waiting for still|not still|moved by|tilted by|turns|shakes",
        "Shelter the aircraft from wind, stand it firmly, motors off, hands off, and calibrate again.",
    ),
    (
        r"is stuck|hits the end|not gravity|is biased by",
        "This sensor may be broken or wrongly set up: companion check.",
    ),
    (
        r"data from imu|was silent|no heartbeat|heartbeat|not heard|is not known yet|not finished in the time",
        "Look at cables, power and the baud rate: companion check says what is heard.",
    ),
    (r"\barmed\b", "Disarm, and calibrate again: nothing is ever written while armed."),
    (r"nose or tail", "Lay the aircraft down: near the vertical its roll is not defined."),
    (
        r"somebody|someone else|another companion|foreign",
        "Somebody else writes these parameters: see docs/autopilots.md on rivals, then calibrate again.",
    ),
    (r"TCAL|temperature calibration", "Let the autopilot finish learning its temperature calibration first."),
    (r"calibrating its own sensors", "Wait until the autopilot's own calibration is over, then calibrate again."),
    (r"old values put back", "The autopilot is as it was before. Calibrate again; if it repeats, keep this report."),
    (r"internal error", "A fault of the program: please report it, with this page and the log."),
    (r"cannot be written|No space|Read-only", "Look at the companion computer's disk: it is full or read-only."),
)
_COMPILED: Final = tuple((re.compile(pattern, re.IGNORECASE), words) for pattern, words in _ADVICE)


def advice(words: str) -> str | None:
    """What to do about a warning or a reason; None where there is nothing particular."""
    return next((what for pattern, what in _COMPILED if pattern.search(words)), None)

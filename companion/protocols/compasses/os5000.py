r"""OceanServer OS5000 family of compasses (OS4000 to OS5500): tagged fields after `$C`, and a checksum.

    $C320.5P0.2R-18.3T19.0*3C\r\n                            heading, pitch, roll, temperature
    $C212.4P2.5R-14.0T28.4Mx107977.90My-79422.00Mz173.27Ax0.045Ay-0.245Az0.977*3A\r\n

The device's settings select the fields. Source: OS5000 user's guide, format type 0x01 (rev. 3.6, p. 12): the heading is
"corrected for declination if one is entered", so the configuration must name its north. Magnetic fields are in
milligauss only after a calibration with the local horizontal field entered; the manual's own example shows 108 gauss.
A magnetic field stronger than any on Earth is therefore left out.
"""

from __future__ import annotations

import re
from typing import Final

from companion.protocols.decoding.base import TEMPERATURE_LIMIT_DEGC, RejectedError, SentenceDecoder, full_circle
from companion.samples import CompassSample, MagSample, Sample, TiltSample

FIELD_LIMIT_GAUSS: Final = 2.0

_NUMBER: Final = rb"([-+]?\d{1,7}(?:\.\d{1,6})?)"
_TAGS: Final = re.compile(rb"(?:C%b)?(?:P%b)?(?:R%b)?(?:T%b)?((?:[A-Z][a-z]?%b)*)" % ((_NUMBER,) * 5))
_VECTOR: Final = re.compile(rb"Mx%bMy%bMz%b" % ((_NUMBER,) * 3))


class Os5000Decoder(SentenceDecoder):
    """Decoder of `$C` sentences into `CompassSample`, `TiltSample` if there is no heading, and `MagSample`."""

    LIMIT = 250  # bytes from the "$" on; a sentence with all possible fields has some 150

    def _read(self, body: bytes, t_s: float) -> list[Sample]:
        match = _TAGS.fullmatch(body)
        if match is None:
            raise RejectedError("not a measurement" if body[:1] == b"C" else "unknown sentence")
        heading, pitch, roll, temperature, more, _ = match.groups()
        samples: list[Sample]
        temperature_degc = None if temperature is None else float(temperature)
        if temperature_degc is not None and not -TEMPERATURE_LIMIT_DEGC <= temperature_degc <= TEMPERATURE_LIMIT_DEGC:
            raise RejectedError("out of range")
        if pitch is None or roll is None:
            if heading is None:
                raise RejectedError("nothing of use")
            samples = [CompassSample(t_s, full_circle(float(heading)), None, None, None, temperature_degc)]
        else:
            pitch_deg, roll_deg = float(pitch), float(roll)
            if not (-90.0 <= pitch_deg <= 90.0 and -180.0 <= roll_deg <= 180.0):
                raise RejectedError("out of range")
            if heading is None:
                if abs(roll_deg) > 90.0:  # upside down: no gradienter
                    raise RejectedError("out of range")
                samples = [TiltSample(t_s, roll_deg, pitch_deg, temperature_degc)]
            else:
                heading_deg = full_circle(float(heading))
                samples = [CompassSample(t_s, heading_deg, pitch_deg, roll_deg, None, temperature_degc)]
        if more and (vector := _VECTOR.search(more)):
            x, y, z = (float(field) / 1000.0 for field in vector.groups())
            if max(abs(x), abs(y), abs(z)) <= FIELD_LIMIT_GAUSS:
                samples.append(MagSample(t_s, (x, y, z)))
        return samples

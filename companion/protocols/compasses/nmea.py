r"""NMEA 0183 sentences of compasses, and the Honeywell HMR3000's own sentences. A checksum is required.

    $HCHDG,271.1,10.7,E,12.2,W*52          the sensor's own reading, deviation, variation: magnetic is 271.1 + 10.7
    $HCHDM,093.8,M*2B                      magnetic heading
    $HEHDT,86.2,T*13    $HETHS,86.2,A*39   true heading; THS has a status: V, S and M mean no measurement
    $HCXDR,A,1.6,D,PITCH,A,-0.3,D,ROLL*65  transducers: PTCH or PITCH, ROLL, and the HMR3000's MAGX, MAGY, MAGZ in mG
    $PTNTHPR,91.7,N,-0.0,N,1.6,N*21        heading, pitch, roll, each with a status (HMR3000)
    $PTNTCCD,522,-472,109,1841,677,1964,86.3*44    tangents of the tilt times 32768, field, heading (HMR3000)

Sources: the Furuno FR-1500 manual for NMEA 0183 (8.6, from IMO A.382), the JRC JLR-30 manual for THS (appendix 2-2),
Honeywell's HMR3000 manual (900240 rev. B, p. 11 to 13, later edition p. 16). The talker may be any two characters.

One compass may send several sentences for one reading, some from magnetic north, some from true north. Only one
sentence is used for headings at a time, in this order of precedence: HPR, HDG, HDM, CCD, THS, HDT. Other sentences
count as duplicates. If the sentence in use is absent for `HOLD_S`, one of lower precedence replaces it, but only one
with the same north. Otherwise the heading would jump by the declination. The order for tilt is HPR, CCD, XDR. A
`CompassSample` names its north, except from HPR: the device may correct an HPR heading by entered values.
"""

from __future__ import annotations

import functools
import math
from typing import Final, Literal

from companion.protocols.decoding.base import RejectedError, SentenceDecoder, check_vector, full_circle, out_of_range
from companion.protocols.decoding.dialogue import PollDialogue
from companion.samples import CompassSample, MagSample, Sample, TiltSample

HOLD_S: Final = 3.0

North = Literal["magnetic", "true"] | None

# Precedence of headings, with the north of each, and of tilts.
_NORTHS: Final[tuple[North, ...]] = ("true", "true", "magnetic", "magnetic", "magnetic", None)
_HDT, _THS, _CCD, _HDM, _HDG, _HPR = range(6)
_TILT_XDR, _TILT_CCD, _TILT_HPR = range(3)
_NOBODY: Final = -1

_PLAIN: Final[dict[bytes, tuple[int, int, tuple[bytes, ...] | None, North]]] = {
    b"HDG": (_HDG, 6, None, "magnetic"),
    b"HDM": (_HDM, 3, (b"M",), "magnetic"),
    b"HDT": (_HDT, 3, (b"T",), "true"),
    # Autonomous, estimated; M was typed in, S is simulated, V not valid.
    b"THS": (_THS, 3, (b"A", b"E"), "true"),
}
"""Sentences with a heading only: precedence, number of fields, allowed third field (None: a deviation), north."""

_ALARMS: Final = frozenset((b"L", b"P"))
_STATUSES: Final = frozenset((b"L", b"M", b"N", b"O", b"P", b"C"))
_DEGREES_PER_MIL: Final = 9 / 160
_CCD_SCALE: Final = 32768.0
_ANGLES: Final = {b"PITCH": b"PITCH", b"PTCH": b"PITCH", b"ROLL": b"ROLL"}
_FIELDS: Final = (b"MAGX", b"MAGY", b"MAGZ")


class NmeaDecoder(SentenceDecoder):
    """Decoder of NMEA sentences into `CompassSample`, `TiltSample` if there is no heading, and `MagSample`."""

    _heading_from = _tilt_from = _NOBODY  # Sentences in use for headings and tilts, and the time of their last one
    _heading_s = _tilt_s = 0.0

    def interrupted(self) -> None:
        super().interrupted()
        self._heading_from = self._tilt_from = _NOBODY

    def _read(self, body: bytes, t_s: float) -> list[Sample]:
        fields = body.split(b",")
        head = fields[0]
        if head == b"PTNTHPR":
            return [self._hpr(fields, t_s)]
        if head == b"PTNTCCD":
            return [self._ccd(fields, t_s)]
        plain = _PLAIN.get(head[2:])
        if head[2:] == b"XDR" and len(head) == 5:
            return self._xdr(fields, t_s)
        if plain is None or len(head) != 5:
            raise RejectedError("unknown sentence")
        rank, size, marks, north = plain
        if len(fields) != size:
            raise RejectedError("field count")
        heading_deg = float(fields[1])
        if marks is None:
            if fields[2] and 0.0 <= heading_deg <= 360.0:
                heading_deg = (heading_deg + _easting(fields[2], fields[3])) % 360.0
        elif fields[2] not in marks:
            raise RejectedError("not a measurement" if rank == _THS else "unknown field")
        heading_deg = full_circle(heading_deg)
        self._claim_heading(rank, t_s)
        return [CompassSample(t_s, heading_deg, None, None, north)]

    def _claim_heading(self, sentence: int, t_s: float) -> None:
        leader = self._heading_from
        if sentence < leader:
            if _NORTHS[sentence] != _NORTHS[leader]:
                raise RejectedError("other north")
            if t_s - self._heading_s <= HOLD_S:
                raise RejectedError("duplicate")
        self._heading_from, self._heading_s = sentence, t_s

    def _hpr(self, fields: list[bytes], t_s: float) -> Sample:
        if len(fields) != 7:
            raise RejectedError("field count")
        _, heading, magnetic, pitch, pitch_status, roll, roll_status = fields
        # A sentence with an alarm keeps its precedence: the device then has no heading, whatever else it sends.
        self._heading_from, self._heading_s = _HPR, t_s
        self._tilt_from, self._tilt_s = _TILT_HPR, t_s
        no_heading = False
        if not magnetic == pitch_status == roll_status == b"N":
            _check_statuses((magnetic, pitch_status, roll_status))
            no_heading = magnetic in _ALARMS
        pitch_deg, roll_deg = float(pitch), float(roll)
        heading_deg = 0.0 if no_heading else float(heading)
        if b"." not in pitch:  # mils are whole numbers, degrees have a decimal
            pitch_deg, roll_deg = pitch_deg * _DEGREES_PER_MIL, roll_deg * _DEGREES_PER_MIL
            heading_deg *= _DEGREES_PER_MIL
        if not (-90.0 <= pitch_deg <= 90.0 and -90.0 <= roll_deg <= 90.0):
            raise out_of_range(pitch_deg + roll_deg)
        heading_deg = full_circle(heading_deg)
        if no_heading:
            return TiltSample(t_s, roll_deg, pitch_deg)
        return CompassSample(t_s, heading_deg, pitch_deg, roll_deg)

    def _ccd(self, fields: list[bytes], t_s: float) -> Sample:
        if len(fields) != 8:
            raise RejectedError("field count")
        pitch_deg, roll_deg = (math.degrees(math.atan(float(field) / _CCD_SCALE)) for field in fields[1:3])
        if not math.isfinite(pitch_deg + roll_deg):
            raise RejectedError("non-finite")
        heading_deg = float(fields[7])
        if b"." not in fields[7]:
            heading_deg *= _DEGREES_PER_MIL
        if self._tilt_from > _TILT_CCD and t_s - self._tilt_s <= HOLD_S:
            raise RejectedError("duplicate")  # of HPR, which has precedence for headings too
        self._tilt_from, self._tilt_s = _TILT_CCD, t_s
        try:
            self._claim_heading(_CCD, t_s)
        except RejectedError:
            return TiltSample(t_s, roll_deg, pitch_deg)
        return CompassSample(t_s, full_circle(heading_deg), pitch_deg, roll_deg, _NORTHS[_CCD])

    def _xdr(self, fields: list[bytes], t_s: float) -> list[Sample]:
        if len(fields) % 4 != 1:
            raise RejectedError("field count")
        angles_deg: dict[bytes, float] = {}
        field_mg: dict[bytes, float] = {}
        for at in range(1, len(fields), 4):
            kind, value, unit, name = fields[at : at + 4]
            if kind == b"A" and name in _ANGLES:
                if unit != b"D":
                    raise RejectedError("unknown field")
                angles_deg[_ANGLES[name]] = _tilt(value)
            elif kind == b"G" and name in _FIELDS and value:
                field_mg[name] = float(value)
        found: list[Sample] = []
        if len(angles_deg) == 2 and not (self._tilt_from > _TILT_XDR and t_s - self._tilt_s <= HOLD_S):
            self._tilt_from, self._tilt_s = _TILT_XDR, t_s
            found.append(TiltSample(t_s, angles_deg[b"ROLL"], angles_deg[b"PITCH"]))
        if len(field_mg) == 3:
            x, y, z = (field_mg[name] / 1000.0 for name in _FIELDS)
            check_vector((x, y, z))
            found.append(MagSample(t_s, (x, y, z)))
        if not found:
            raise RejectedError("duplicate" if len(angles_deg) == 2 else "nothing of use")
        return found


def _check_statuses(statuses: tuple[bytes, bytes, bytes]) -> None:
    if not _STATUSES.issuperset(statuses):
        raise RejectedError("not a measurement")
    if b"C" in statuses:
        raise RejectedError("calibrating")
    if not _ALARMS.isdisjoint(statuses[1:]):
        raise RejectedError("alarm")


def _easting(field: bytes, side: bytes) -> float:
    value = float(field)
    if not 0.0 <= value <= 180.0:
        raise out_of_range(value)
    if side == b"E":
        return value
    if side != b"W":
        raise RejectedError("unknown field")
    return -value


def _tilt(field: bytes) -> float:
    if not field:
        raise RejectedError("over range")
    value = float(field)
    if not -90.0 <= value <= 90.0:
        raise out_of_range(value)
    return value


# For an HMR3000, which is delivered with all sentences switched off; for others the sentence is unknown. It measures
# 13.75 times a second (HMR3000 manual, p. 8). Streaming would need the rates of its sentences in EEPROM (3.8).
Hmr3000Dialogue = functools.partial(PollDialogue, b"$PTNT,HPR*78\r\n", "$PTNT,HPR*78", period_s=0.1)

"""What is said to an IMU that keeps silent, so that it streams again; nothing of it outlives its power.

A device that sends anything, be it what it was not asked for, is left alone. Pauses double from one attempt to the
next, so that a device that is off or deaf is not shouted at for ever.
"""

from __future__ import annotations

from typing import ClassVar, Final

from companion.protocols.decoding.base import xor_checksum
from companion.protocols.decoding.dialogue import SILENT_S, Dialogue

LONGEST_PAUSE_S: Final = 64.0


class WhenSilent(Dialogue):
    """Says one thing after another, and begins again, as long as nothing is heard."""

    SAYINGS: ClassVar[tuple[tuple[bytes, str], ...]]
    """What to send, and the words for it."""

    def __init__(self) -> None:
        self._quiet_since_s: float | None = None
        self._pause_s = SILENT_S
        self._next = 0
        self._words = ""

    def opened(self, t_s: float) -> None:  # noqa: D102 - as in the base class
        self._quiet_since_s, self._pause_s, self._next, self._words = t_s, SILENT_S, 0, ""

    def heard(self, data: bytes, samples: int, t_s: float) -> None:  # noqa: D102 - as in the base class
        if data:
            self._quiet_since_s = t_s
        if samples:
            self._pause_s, self._next = SILENT_S, 0

    def due(self, t_s: float) -> bytes:  # noqa: D102 - as in the base class
        if self._quiet_since_s is None or t_s - self._quiet_since_s < self._pause_s:
            return b""
        saying, self._words = self.SAYINGS[self._next]
        self._next += 1
        if self._next == len(self.SAYINGS):
            self._next, self._pause_s = 0, min(2.0 * self._pause_s, LONGEST_PAUSE_S)
        self._quiet_since_s = t_s
        return saying

    @property
    def words(self) -> str:  # noqa: D102 - as in the base class
        return self._words


class MipDialogue(WhenSilent):
    """Base command 0x06: an idle device sends again what it is set to send (mip_sdk: "out of idle mode")."""

    SAYINGS = ((bytes.fromhex("756501020206E5CB"), "stream resumed with MIP command 01 06"),)


class XsensDialogue(WhenSilent):
    """GoToMeasurement: from the config state back to sending (MT0605P.E, p. 53).

    A device that has just got power says WakeUp and waits half a second. It is answered with the same: WakeUpAck would
    put it into the config state, and a device that is set not to measure by itself waits for ever.
    """

    SAYINGS = ((bytes.fromhex("FAFF1000F1"), "measurement started with GoToMeasurement"),)
    WAKE_UP: ClassVar[bytes] = bytes.fromhex("FAFF3E00C3")

    def __init__(self) -> None:
        super().__init__()
        self._tail = b""
        self._woken = False

    def opened(self, t_s: float) -> None:  # noqa: D102 - as in the base class
        super().opened(t_s)
        self._tail, self._woken = b"", False

    def heard(self, data: bytes, samples: int, t_s: float) -> None:  # noqa: D102 - as in the base class
        super().heard(data, samples, t_s)
        text = self._tail + data
        self._tail = text[-(len(self.WAKE_UP) - 1) :]
        # What it said after the WakeUp shows that it has gone on by itself.
        self._woken = text.endswith(self.WAKE_UP) or (self._woken and not data)

    def due(self, t_s: float) -> bytes:  # noqa: D102 - as in the base class
        if not self._woken:
            return super().due(t_s)
        self._woken, self._quiet_since_s = False, t_s
        saying, self._words = self.SAYINGS[0]
        return saying


def _vectornav(body: bytes) -> bytes:
    return b"$%b*%02X\r\n" % (body, xor_checksum(body))


class VectorNavDialogue(WhenSilent):
    """First end a pause of the outputs, then choose the factory's output, $VNYMR, on the port that we speak on.

    UM001: p. 56 (a pause changes no register), p. 63 (register 6 without a port is that of the port in use), p. 54
    (registers are kept over a reset only by $VNWNV, which is never sent from here). A device without any output set is
    rare; binary outputs (register 75) are not touched, as they name a port by its number, which is not known here.
    """

    SAYINGS = (
        (_vectornav(b"VNASY,1"), "outputs resumed with $VNASY,1"),
        (_vectornav(b"VNWRG,06,14"), "$VNYMR chosen with $VNWRG,06,14, until power is cut"),
    )

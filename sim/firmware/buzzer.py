"""The buzzer of a double: PLAY_TUNE note by note, written from MAVLink's text and the firmwares.

Both firmwares take QBasic's PLAY (ArduPilot MMLPlayer.cpp, PX4 lib/tunes/tunes.cpp); this module has only
the part that signals need.
"""

from __future__ import annotations

import itertools
import re
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

_WORD = re.compile(r"M[FNL]|T\d+|O\d|L\d+|[<>]|[A-G][#+-]?\d*\.?|[PR]\d*")
_SEMITONES = {"C": 0, "D": 2, "E": 4, "F": 5, "G": 7, "A": 9, "B": 11}
LONG_NOTE_S = 0.4


class Note(NamedTuple):
    """One tone, or silence (0 Hz)."""

    frequency_hz: float
    seconds: float


class Played(NamedTuple):
    at_s: float
    notes: tuple[Note, ...]

    @property
    def seconds(self) -> float:
        return sum(note.seconds for note in self.notes)

    def __str__(self) -> str:
        """Describe the sound, such as "2 short notes, rising"."""
        heard = [note for note in self.notes if note.frequency_hz]
        if not heard:
            return "silence"
        tones = [note.frequency_hz for note in heard]
        steps = {later > earlier for earlier, later in itertools.pairwise(tones)}
        way = {(): "", (True,): ", rising", (False,): ", falling"}.get(tuple(steps), ", up and down")
        length = "long" if max(note.seconds for note in heard) > LONG_NOTE_S else "short"
        return f"{len(heard)} {length} note{'s' if len(heard) > 1 else ''}{way}"


class Buzzer:
    """Plays tunes. `goes_on`: an interrupting tune starts at the position that the last tune had reached, as in PX4."""

    def __init__(self, *, goes_on: bool) -> None:
        self.played: list[Played] = []
        self.broken_off = 0
        """Number of tunes that a later tune cut short, or that began in the middle."""
        self._goes_on = goes_on

    def take(self, message: mavlink.MAVLink_play_tune_message, now_s: float) -> None:
        tune = Played(now_s, notes_of(message.tune + message.tune2))
        if self.played and now_s < self.played[-1].at_s + self.played[-1].seconds:
            self.broken_off += 1
            if self._goes_on:
                return
        self.played.append(tune)

    @property
    def heard(self) -> list[str]:
        """Describe all tunes that were played."""
        return [str(tune) for tune in self.played]


def notes_of(text: str) -> tuple[Note, ...]:
    tempo, octave, length, sounding = 120, 4, 4, 7.0 / 8.0
    found: list[Note] = []
    rest = text.upper().replace(" ", "")
    while rest:
        match = _WORD.match(rest)
        if match is None:
            raise ValueError(f"{rest!r} of {text!r} is no tune")
        word, rest = match[0], rest[match.end() :]
        kind, number = word[0], int("".join(filter(str.isdigit, word)) or 0)
        if kind == "T":
            tempo = number
        elif kind == "O":
            octave = min(number, 6)
        elif kind == "L":
            length = number
        elif kind in "<>":
            octave = min(max(octave + (1 if kind == ">" else -1), 0), 6)
        elif word in ("MN", "ML"):
            sounding = 1.0 if word == "ML" else 7.0 / 8.0
        elif kind in "PR":
            found.append(Note(0.0, 240.0 / tempo / (number or 1)))
        elif kind in _SEMITONES:
            semitone = _SEMITONES[kind] + 12 * octave + 1 + (word[1:2] in ("#", "+")) - (word[1:2] == "-")
            seconds = 240.0 / tempo / (number or length) * (1.5 if word.endswith(".") else 1.0)
            silent = seconds * (1.0 - sounding)
            found.append(Note(880.0 * 2.0 ** ((semitone - 46) / 12.0), seconds - silent))
            if silent:
                found.append(Note(0.0, silent))
    return tuple(found)

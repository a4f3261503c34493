"""A person who handles the aircraft: turns it on its spot, tilts it, puts it back.

A spot is a plane. In all headings on a spot, the aircraft's down axis is the plane's normal, except for the error of
placing the aircraft by hand. Typed lines move the aircraft while a simulation runs (`python -m sim all --hands`), or
the requests of companion and autopilots (`follow`).
"""

from __future__ import annotations

import asyncio
import math
import os
import re
import stat
import sys
from collections.abc import Callable
from typing import Final

import numpy as np

from sim.aircraft import Pose, VirtualAircraft
from sim.earth import Array, angles_of, axis_rotation, body_from_ned
from sim.motions import Handling, Turn

TAKES_S: Final = 6.0
AHEAD_S: Final = 0.1
"""Lead of a real firmware's readings over the simulator's clock."""
PLACEMENT_DEG, PROPPED_DEG = 0.02, 4.0
"""Sigmas of the error when placing the aircraft on marks by careful hands, and when propping it up; degrees."""
HANDS: Final = (
    "turn DEG: clockwise on its spot; tilt PITCH ROLL: nose up and right side down against its spot (tilt 20 0); hold"
    " PITCH ROLL: against the horizon (hold 0 180: on its back; hold 45 0: nose half up); spot PITCH"
    " ROLL: onto another spot, which slopes so; back: onto its spot; bump PITCH ROLL: the spot tips; grip SECONDS: a"
    " hand stays on it; wait SECONDS: before the next line; truth: pose, and biases of the last minute"
)
"""Typed lines, each with its meaning."""
SIDES: Final = {
    "level": (0.0, 0.0),
    "on its back": (0.0, 180.0),
    "nose up": (90.0, 0.0),
    "nose down": (-90.0, 0.0),
    "left side down": (0.0, -90.0),
    "right side down": (0.0, 90.0),
}
"""Pitch and roll for each side, by the name that the companion uses."""
_SIDE = "|".join(SIDES)
_MISSING = re.compile(
    rf"(?:: |now )(?:(?:({_SIDE}) with )?(nose|left side|right side) half (up|down)|({_SIDE}))(?=[:;]|$)"
)
_TURN = re.compile(r"turn it (?:by|on by) (\d+) deg")


class Hands:
    """Moves one aircraft.

    Args:
        aircraft: the aircraft, standing on its spot.
        placement_deg: one sigma of the angle between down axis and the spot's normal at each placing, each axis.
        propped_deg: one sigma of pitch and roll errors when propped up by hand.
        seed: seed of both errors.
        takes_s: duration of each movement.
    """

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        placement_deg: float = 0.0,
        propped_deg: float = 0.0,
        seed: int = 0,
        takes_s: float = TAKES_S,
    ) -> None:
        self._takes_s = takes_s
        self._aircraft, self._placement_deg, self._propped_deg = aircraft, placement_deg, propped_deg
        self._random = np.random.default_rng([seed, 31])
        pose = aircraft.pose
        self._spot = body_from_ned(*(math.radians(a) for a in (pose.roll_deg, pose.pitch_deg, pose.heading_deg)))
        self._turned_deg = 0.0
        self._now = pose
        self._number = 0

    def turn(self, t_s: float, degrees: float) -> float:
        """Turn the aircraft on its spot from aircraft time `t_s`; return the time at which it is motionless again."""
        self._turned_deg += degrees
        return self.back(t_s, degrees)

    def back(self, t_s: float, turn_deg: float = 0.0) -> float:
        """Put the aircraft back on its spot, turned by about `turn_deg`."""
        attitude = axis_rotation(2, -math.radians(self._turned_deg)) @ self._spot
        miss = np.radians(self._placement_deg) * self._random.standard_normal(2)
        attitude = axis_rotation(0, miss[0]) @ axis_rotation(1, miss[1]) @ attitude
        return self._go(t_s, attitude, turn_deg)

    def tilt(self, t_s: float, pitch_deg: float, roll_deg: float) -> float:
        """Prop the aircraft up relative to its pose on the spot: nose up, right side down."""
        attitude = axis_rotation(2, -math.radians(self._turned_deg)) @ self._spot
        attitude = axis_rotation(0, -math.radians(roll_deg)) @ axis_rotation(1, -math.radians(pitch_deg)) @ attitude
        return self._go(t_s, attitude)

    def hold(self, t_s: float, pitch_deg: float, roll_deg: float) -> float:
        """Prop the aircraft up in any orientation relative to the horizon: nose up, right side down."""
        pitch_off, roll_off = self._propped_deg * self._random.standard_normal(2)
        return self._go(t_s, self._held(pitch_deg + pitch_off, roll_deg + roll_off))

    def grip(self, t_s: float, seconds: float) -> float:
        """Hold the aircraft in the hands: it trembles by some tenths of a degree, and ends in its initial pose."""
        self._number += 1
        tremor = Handling(start_s=t_s, duration_s=seconds, angle_deg=0.4, acceleration=0.1, seed=self._number)
        self._aircraft.add(tremor)
        return tremor.end_s

    def follow(self, words: str, t_s: float) -> bool:
        """Obey a request of `companion align`; return False if the words are no such request."""
        if (missing := _MISSING.search(words)) is not None:
            base, part, way, whole = missing.groups()
            names = [whole] if whole else [base or "level", f"{part} {way}"]
            up = np.mean([_up(*SIDES[name]) for name in names], axis=0)
            up /= np.linalg.norm(up)
            self.hold(t_s, math.degrees(math.asin(up[0])), math.degrees(math.atan2(-up[1], -up[2])))
        elif (asked := _TURN.search(words)) is not None:
            self.turn(t_s, float(asked[1]))
        elif "turn it the same way to its first marks" in words:
            self.turn(t_s, math.copysign(360.0, self._turned_deg) - self._turned_deg)
        else:
            return False
        return True

    def spot(self, t_s: float, pitch_deg: float, roll_deg: float) -> float:
        """Place the aircraft on another spot, with this initial pose."""
        self._spot, self._turned_deg = self._held(pitch_deg, roll_deg), 0.0
        return self.back(t_s)

    def _held(self, pitch_deg: float, roll_deg: float) -> Array:
        return body_from_ned(*(math.radians(a) for a in (roll_deg, pitch_deg, self._now.heading_deg)))

    def bump(self, _t_s: float, pitch_deg: float, roll_deg: float) -> None:
        """Tip the spot itself, relative to the aircraft's first heading; the change shows at the next placing."""
        tipped = axis_rotation(0, -math.radians(roll_deg)) @ axis_rotation(1, -math.radians(pitch_deg))
        self._spot = tipped @ self._spot

    def _go(self, t_s: float, attitude: Array, turn_deg: float = 0.0) -> float:
        roll, pitch, heading = (math.degrees(angle) for angle in angles_of(attitude))
        before, self._number = self._now, self._number + 1
        # The way that was asked for; else the short one, as an arm goes.
        turn = turn_deg + math.remainder(heading - before.heading_deg - turn_deg, 360.0)
        self._aircraft.add(
            Turn(
                start_s=t_s,
                duration_s=self._takes_s,
                roll_deg=math.remainder(roll - before.roll_deg, 360.0),
                pitch_deg=pitch - before.pitch_deg,
                heading_deg=turn,
            )
        )
        self._aircraft.add(Handling(start_s=t_s, duration_s=self._takes_s, seed=self._number))
        self._now = Pose(pitch, roll, before.heading_deg + turn)
        return t_s + self._takes_s

    def obey(self, line: str, t_s: float) -> str:
        word, *rest = line.split() or [""]
        moves: dict[str, tuple[int, Callable[..., object]]] = {
            "turn": (1, self.turn), "tilt": (2, self.tilt), "hold": (2, self.hold), "spot": (2, self.spot),
            "back": (0, self.back), "bump": (2, self.bump), "grip": (1, self.grip),
        }  # fmt: skip
        count, move = moves.get(word, (-1, self.back))
        try:
            figures = [float(figure) for figure in rest]
        except ValueError:
            count, figures = -1, []
        if len(figures) != count:
            return HANDS if word == "help" else f"found {line.strip()!r}; type help"
        move(t_s, *figures)
        if word == "bump":
            return "the spot has tipped; it shows when the aircraft is put onto it again"
        if word == "grip":
            return f"a hand stays on it for {figures[0]:g} s"
        pose = self._now
        return (
            f"moving for {self._takes_s:g} s; then pitch {pose.pitch_deg:.2f}, roll {pose.roll_deg:.2f},"
            f" heading {pose.heading_deg % 360.0:.1f} deg"
        )


def _up(pitch_deg: float, roll_deg: float) -> Array:
    return -body_from_ned(math.radians(roll_deg), math.radians(pitch_deg), 0.0)[:, 2]


async def take_lines(
    hands: Hands, aircraft: VirtualAircraft, say: Callable[[str], None], truth: Callable[[float], str]
) -> None:
    """Read lines from standard input, a terminal or a script, and obey each, until the input ends.

    `truth` describes the true pose and biases at an aircraft time.
    """
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader()
    mode = os.fstat(sys.stdin.fileno()).st_mode
    if sys.stdin.isatty() or stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode):
        await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    else:  # a file, or /dev/null: asyncio waits for neither
        reader.feed_data(sys.stdin.buffer.read())
        reader.feed_eof()
    while line := await reader.readline():
        words = line.decode(errors="replace")
        if (waiting := re.fullmatch(r"\s*wait\s+([0-9.]+)\s*", words)) is not None:
            await asyncio.sleep(float(waiting[1]))
        elif words.strip() == "truth":
            say(truth(aircraft.time_at(loop.time())))
        elif words.strip():
            say(hands.obey(words, aircraft.time_at(loop.time()) + AHEAD_S))

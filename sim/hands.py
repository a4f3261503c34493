"""Somebody who takes hold of the aircraft: turns it on its spot, tilts it, puts it back.

A spot is a plane. However the aircraft is turned on it, its down axis stays the plane's normal, but for what the hands
leave (`placement`). Typed lines make it so while a simulation runs: `python -m sim all --hands`.
"""

from __future__ import annotations

import asyncio
import math
import sys
from collections.abc import Callable
from typing import Final

import numpy as np

from sim.aircraft import Pose, VirtualAircraft
from sim.earth import angles_of, axis_rotation, body_from_ned
from sim.motions import Handling, Turn

TAKES_S: Final = 6.0
HELP: Final = "turn DEG | tilt PITCH ROLL | hold PITCH ROLL | spot PITCH ROLL | back | bump PITCH ROLL"
_EXAMPLES: Final = (
    "turn 180: clockwise on its spot; tilt 20 0: nose up; hold 0 180: on its back, whatever the spot; spot 3 0:"
    " onto another one, which slopes; back: onto its spot; bump 0.3 0: the spot tips"
)


class Hands:
    """Moves one aircraft.

    Args:
        aircraft: as it stands now, so does it stand on its spot.
        placement_deg: one sigma of how the down axis misses the spot's normal each time, each axis.
        seed: of that.
    """

    def __init__(self, aircraft: VirtualAircraft, *, placement_deg: float = 0.0, seed: int = 0) -> None:
        self._aircraft, self._placement_deg = aircraft, placement_deg
        self._random = np.random.default_rng([seed, 31])
        pose = aircraft.pose
        self._spot = body_from_ned(*(math.radians(a) for a in (pose.roll_deg, pose.pitch_deg, pose.heading_deg)))
        self._turned_deg = 0.0
        self._now = pose
        self._number = 0

    def turn(self, t_s: float, degrees: float) -> float:
        """Turn it on its spot from aircraft time `t_s` on; returns when it stands again."""
        self._turned_deg += degrees
        return self.back(t_s)

    def back(self, t_s: float) -> float:
        """Put it onto its spot as it is turned."""
        attitude = axis_rotation(2, -math.radians(self._turned_deg)) @ self._spot
        miss = np.radians(self._placement_deg) * self._random.standard_normal(2)
        attitude = axis_rotation(0, miss[0]) @ axis_rotation(1, miss[1]) @ attitude
        return self._go(t_s, attitude)

    def tilt(self, t_s: float, pitch_deg: float, roll_deg: float) -> float:
        """Prop it up: nose up, right side down, from how it stands on its spot."""
        attitude = axis_rotation(2, -math.radians(self._turned_deg)) @ self._spot
        attitude = axis_rotation(0, -math.radians(roll_deg)) @ axis_rotation(1, -math.radians(pitch_deg)) @ attitude
        return self._go(t_s, attitude)

    def hold(self, t_s: float, pitch_deg: float, roll_deg: float) -> float:
        """Prop it up anywhere, in any orientation: nose up, right side down, from the horizon."""
        return self._go(t_s, self._held(pitch_deg, roll_deg))

    def spot(self, t_s: float, pitch_deg: float, roll_deg: float) -> float:
        """Put it onto another spot, on which it stands like this at first."""
        self._spot, self._turned_deg = self._held(pitch_deg, roll_deg), 0.0
        return self.back(t_s)

    def _held(self, pitch_deg: float, roll_deg: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        """As it heads now."""
        return body_from_ned(*(math.radians(a) for a in (roll_deg, pitch_deg, self._now.heading_deg)))

    def bump(self, pitch_deg: float, roll_deg: float) -> None:
        """Tip the spot itself, nose up and right side down as the aircraft was at first; seen at the next placing."""
        tipped = axis_rotation(0, -math.radians(roll_deg)) @ axis_rotation(1, -math.radians(pitch_deg))
        self._spot = tipped @ self._spot

    def _go(self, t_s: float, attitude: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
        roll, pitch, heading = (math.degrees(angle) for angle in angles_of(attitude))
        before, self._number = self._now, self._number + 1
        # The short way round, as an arm goes.
        turn = math.remainder(heading - before.heading_deg, 360.0)
        self._aircraft.add(
            Turn(
                start_s=t_s,
                duration_s=TAKES_S,
                roll_deg=math.remainder(roll - before.roll_deg, 360.0),
                pitch_deg=pitch - before.pitch_deg,
                heading_deg=turn,
            )
        )
        self._aircraft.add(Handling(start_s=t_s, duration_s=TAKES_S, seed=self._number))
        self._now = Pose(pitch, roll, before.heading_deg + turn)
        return t_s + TAKES_S

    def obey(self, line: str, t_s: float) -> str:
        """Do what one typed line says; returns what came of it."""
        word, *rest = line.split() or [""]
        try:
            figures = [float(figure) for figure in rest]
            if word == "turn" and len(figures) == 1:
                self.turn(t_s, figures[0])
            elif word == "tilt" and len(figures) == 2:
                self.tilt(t_s, figures[0], figures[1])
            elif word == "hold" and len(figures) == 2:
                self.hold(t_s, figures[0], figures[1])
            elif word == "spot" and len(figures) == 2:
                self.spot(t_s, figures[0], figures[1])
            elif word == "back" and not figures:
                self.back(t_s)
            elif word == "bump" and len(figures) == 2:
                self.bump(figures[0], figures[1])
                return "the spot has tipped; it shows when the aircraft is put onto it again"
            else:
                raise ValueError
        except ValueError:
            return f"found {line.strip()!r}; allowed: {HELP} ({_EXAMPLES})"
        pose = self._now
        return (
            f"moving for {TAKES_S:g} s; then pitch {pose.pitch_deg:.2f}, roll {pose.roll_deg:.2f},"
            f" heading {pose.heading_deg % 360.0:.1f} deg"
        )


async def take_lines(hands: Hands, aircraft: VirtualAircraft, say: Callable[[str], None]) -> None:
    """Obey standard input line by line until it ends."""
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    while line := await reader.readline():
        say(hands.obey(line.decode(errors="replace"), aircraft.time_at(loop.time())))

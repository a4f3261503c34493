"""Error rate and delay of the fleet's judgement: python -m tests.judgement_study.

Aircraft with two IMUs and a compass are drawn, each power-up of `FLIGHTS` a month; the draws are this module's own. A
part scatters as Student's t with 5 degrees of freedom, by its own scale; its bias wanders, follows the temperature of
the seasons along a cubic, and one window in a hundred was knocked. Then one fault each is put in, in the scatters of
its model.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from companion.fleet.judgement import PartHistory, columns_of, compass_column, counts
from companion.fleet.sequential import Alarm, Columns, scatter_of_model, scatter_of_part, watch
from companion.physics.frames import Floats
from companion.physics.units import DEG_H, MG

FLIGHTS: Final = 20
"""Power-ups with a calibration, an aircraft and month."""
TURN_ON: Final = np.array([12.0 * DEG_H] * 3 + [1.5 * MG] * 3)
WHITE: Final = np.array([7.0 * DEG_H] * 3 + [0.06 * MG] * 3)
PER_K: Final = np.array([15.0 * DEG_H] * 3 + [0.15 * MG] * 3)
FAULTS: Final = (
    "bias moves by 4 scatters",
    "bias drifts by 0.15 scatters a flight",
    "scatter times 3",
    "noise times 2",
)


def fly(dice: np.random.Generator, n: int, fault: str = "", since: int = 0, column: int = 0) -> PartHistory:
    """One IMU over `n` power-ups; from `since` on with a fault of one column."""
    own = TURN_ON * np.exp(dice.normal(0.0, 0.25, 6))
    month = np.arange(n) / FLIGHTS
    degc = 15.0 + 12.0 * np.sin(2.0 * np.pi * (month / 12.0 + dice.uniform())) + dice.normal(0.0, 5.0, n)
    scatter = dice.standard_t(5.0, (n, 6)) / 1.077
    slow = np.cumsum(dice.normal(0.0, 0.02, (n, 6)), axis=0)
    knocked = (dice.uniform(size=n) < 0.01)[:, None] * dice.normal(0.0, 8.0, (n, 6))
    white = WHITE * np.exp(dice.normal(0.0, 0.15, 6))
    late = np.arange(n) >= since
    if fault == FAULTS[0]:
        slow[:, column] += 4.0 * late * (TURN_ON / own)[column]
    elif fault == FAULTS[1]:
        slow[:, column] += 0.15 * np.maximum(np.arange(n) - since, 0) * (TURN_ON / own)[column]
    elif fault == FAULTS[2]:
        scatter[late, column] *= 3.0
    noise = np.tile(white, (n, 1))
    if fault == FAULTS[3]:
        noise[late, column] *= 2.0
    warmer = (degc - 20.0)[:, None]
    law = PER_K * (dice.normal(size=6) * warmer + dice.normal(0.0, 0.01, 6) * warmer**2)
    law = law + PER_K * dice.normal(0.0, 1e-4, 6) * warmer**3
    seconds = dice.uniform(12.0, 60.0, (n, 1))
    poor = np.where(dice.uniform(size=(n, 1)) < 0.05, 2.0 * TURN_ON, 0.0)
    stat = noise * np.sqrt(dice.chisquare(seconds / 1.5, (n, 6)) / (seconds / 1.5))
    error = noise / np.sqrt(seconds) * dice.normal(size=(n, 6)) + poor * dice.normal(size=(n, 6))
    # A thermometer that lags, and one calibration in fifty without.
    told = np.where(dice.uniform(size=n) < 0.02, np.nan, degc + dice.normal(0.0, 0.2, n))
    warming = dice.uniform(size=(n, 1)) < 0.05
    use = np.sqrt(np.square(noise) / seconds + poor**2 + np.square(0.3 * TURN_ON))
    return PartHistory(
        at=(),
        temperature_degc=told,
        biases=TURN_ON * dice.normal(0.0, 10.0, 6) + own * (scatter + slow + knocked) + law + error,
        sigma_use=np.where(warming, 15.0 * use, use),
        white=np.where(warming, 2.0 * stat, stat),
        new_zero=dice.uniform(size=n) < 1.0 / 80.0,
    )


def bounds(dice: np.random.Generator, n: int, iron_since: int | None = None) -> Floats:
    """The bounds of a heading's error; one site in twenty is one with iron."""
    found = 2.5 * np.exp(dice.normal(0.0, 0.35, n) + (dice.uniform(size=n) < 0.05) * dice.normal(1.0, 0.5, n))
    return np.where(np.arange(n) >= n + 1 if iron_since is None else np.arange(n) >= iron_since, 3.0 * found, found)


def alarms_of(parts: Sequence[Columns]) -> Iterator[tuple[int, Alarm]]:
    """Counted alarms by part; all parts have as many power-ups."""
    wide = parts[0].values.shape[1]
    joined = (np.concatenate([part[k] for part in parts], axis=-1) for k in range(len(Columns._fields)))
    columns = Columns(*joined)
    for alarm in watch(columns):
        part, column = divmod(alarm.column, wide)
        one = alarm._replace(column=column if wide > 1 else 6)
        if counts(one):
            yield part, one


def model_by(histories: Sequence[PartHistory]) -> Floats | None:
    return scatter_of_model([scatter_of_part(each.biases, each.temperature_degc) for each in histories])


@dataclasses.dataclass(frozen=True)
class FalseAlarms:
    months: float
    """Aircraft times months."""
    by_kind: dict[str, int]

    @property
    def per_hundred_a_month(self) -> float:
        """Aircraft."""
        return 100.0 * sum(self.by_kind.values()) / self.months


def false_alarms(aircraft: int, years: float, seed: int, *, alone: bool = False) -> FalseAlarms:
    """`alone`: nothing is known of the model."""
    dice = np.random.default_rng(seed)
    n = round(12 * FLIGHTS * years)
    found = {"level": 0, "scatter": 0, "noise": 0, "compass": 0}
    histories = [fly(dice, n) for _ in range(2 * aircraft)]
    model = None if alone else model_by(histories)
    for _, alarm in alarms_of([columns_of(each, model) for each in histories]):
        found["noise" if alarm.column >= 6 else alarm.kind] += 1
    for _ in alarms_of([compass_column(bounds(dice, n)) for _ in range(aircraft)]):
        found["compass"] += 1
    return FalseAlarms(12.0 * aircraft * years, found)


def delays(fault: str, parts: int, since: int, seed: int, *, alone: bool = False) -> Floats:
    """Power-ups from the fault to its finding, (parts,); infinite: not within 100."""
    dice = np.random.default_rng(seed)
    n = since + 100
    if fault == "compass got iron":
        columns = [compass_column(bounds(dice, n, since)) for _ in range(parts)]
    else:
        model = None if alone else model_by([fly(dice, 240) for _ in range(30)])
        columns = [columns_of(fly(dice, n, fault, since, k % 6), model) for k in range(parts)]
    found = np.full(parts, np.inf)
    for part, alarm in alarms_of(columns):
        right = fault == "compass got iron" or alarm.column == part % 6 + 6 * (fault == FAULTS[3])
        if right and alarm.at >= since:
            found[part] = min(found[part], alarm.at - since + 1)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.judgement_study", description=__doc__.splitlines()[0])
    parser.add_argument("--aircraft", type=int, default=100)
    parser.add_argument("--years", type=float, default=5.0)
    parser.add_argument("--parts", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print(f"{FLIGHTS} power-ups an aircraft and month")
    for alone in (False, True):
        found = false_alarms(given.aircraft, given.years, given.seed, alone=alone)
        print(
            f"false alarms a hundred aircraft and month, {'no model known' if alone else 'with its model'}:"
            f" {found.per_hundred_a_month:.2f} ({found.by_kind} in {found.months:.0f} aircraft-months)",
            flush=True,
        )
    print(f"{'power-ups until it is found':48} {'median':>6} {'90 %':>6} {'95 %':>6}   alone: likewise")
    for since in (60, 240):
        for fault in (*FAULTS, "compass got iron"):
            figures = [delays(fault, given.parts, since, given.seed, alone=alone) for alone in (False, True)]
            words = [f"{np.quantile(each, q, method='higher'):6.0f}" for each in figures for q in (0.5, 0.9, 0.95)]
            print(f"{fault + f', after {since}':48} {' '.join(words[:3])}          {' '.join(words[3:])}", flush=True)


if __name__ == "__main__":
    main()

"""How much longer a deck takes: what is said, against when the estimates of a simulated sea really are good enough."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from companion.component.statustext import LINE_BYTES
from companion.estimation.deck.deck import Aim, Deck, aim, more
from companion.estimation.deck.estimate import DeckFound, Known
from companion.estimation.means.windows import ImuInput
from companion.estimation.noise.allan import PROFILES
from sim.accuracy.deck import Voyage, feed
from sim.aircraft import Pose, Site, VirtualAircraft
from sim.imu_model import DEG_H, ImuModel
from tests.unit.estimation.test_deck import AROUND


@pytest.mark.parametrize(
    ("voyage", "goal_deg_h", "least_s", "factor"),
    [(Voyage(turn_deg_s=0.0), 5.5, 90, 1.5), (Voyage(turn_deg_s=0.8), 13.0, 120, 2.5)],
    ids=["at its mooring", "turning"],
)
def test_the_time_that_is_said_is_the_time_it_takes(voyage: Voyage, goal_deg_h: float, least_s: int, factor: float) -> None:
    """Within a factor, or a window: of a short turn nobody knows yet how much it will tell."""
    aircraft = VirtualAircraft(Pose(2.0, -1.0, 70.0), Site(latitude_deg=45.0), motions=voyage.motions(5))
    deck = Deck(*AROUND)
    deck.set_imu(ImuInput(name="imu", rotation=np.eye(3), profile=PROFILES["icm42688p"]))
    feed(deck, ImuModel(aircraft, "icm42688p", seed=5), 212, np.random.default_rng(5), 1.0)
    past: list[tuple[int, Known]] = []
    said: list[Aim] = []
    for end in range(60, 211, 30 if least_s > 100 else 15):
        found = deck.work(range(1, 1 + end)).run()
        assert isinstance(found, DeckFound)
        past.append((end, found.known[0]))
        said.append(aim(past[0], past[-1], goal_deg_h * DEG_H))
        if said[-1].sigma <= said[-1].goal:
            break
    done_s = past[-1][0]
    assert said[-1].sigma <= said[-1].goal
    assert done_s >= least_s
    for each, one in zip(past, said[:-1], strict=False):
        left_s = done_s - each[0]
        assert left_s / factor - 15.0 <= one.whole_s - each[0] <= left_s * factor + 15.0, (each[0], one, done_s)


def test_it_fits_into_one_statustext() -> None:
    seconds = (1, 55, 89, 91, 300, 1139)
    deg_h = [Aim(sigma, goal, 0).in_words(1.0, "deg/h") for sigma, goal in ((9.96, 5.0), (412.0, 6.13), (52.0, 49.6))]
    mg = [Aim(sigma, goal, 0).in_words(1.0, "mg") for sigma, goal in ((0.271, 0.2), (1.34, 0.051))]
    for left_s, words in itertools.product(seconds, deg_h + mg):
        assert len(f"{more(left_s)}: {words}") <= LINE_BYTES
    assert (more(1), more(55), more(89), more(91), more(300)) == (
        "some 10 s more", "some 60 s more", "some 90 s more", "some 2 min more", "some 5 min more",
    )  # fmt: skip
    assert deg_h == ["10 deg/h, goal 5.0", "412 deg/h, goal 6.1", "52 deg/h, goal 50"]
    assert mg == ["0.27 mg, goal 0.20", "1.3 mg, goal 0.05"]

"""docs/sensors.md: a row for every protocol, and what stands in it is what the code does."""

from __future__ import annotations

import re
from typing import NamedTuple

import pytest

from companion.configured import models
from companion.protocols.registry import PROTOCOLS, Kind, ProtocolInfo
from tests.support.documents import ROOT

TEXT = (ROOT / "docs" / "sensors.md").read_text(encoding="utf-8")
COLUMNS = ("device", "protocol", "roles", "line", "law", "sign", "sigma", "lag", "sent", "checked against")


class Row(NamedTuple):
    """One row, by its columns."""

    device: str
    protocol: str
    roles: str
    line: str
    law: str
    sign: str
    sigma: str
    lag: str
    sent: str
    checked: str


def table() -> list[Row]:
    lines = TEXT.splitlines()
    start = lines.index(f"| {' | '.join(COLUMNS)} |")
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip()[1:-1])]
        assert len(cells) == len(COLUMNS), line
        rows.append(Row(*cells))
    return rows


ROWS = {row.protocol.strip("`"): row for row in table()}
USED: list[tuple[Kind, ProtocolInfo]] = [(kind, info) for kind, infos in PROTOCOLS.items() for info in infos.values()]


def figure(value: float) -> str:
    """As the table writes it: two figures."""
    return f"{float(f'{value:.2g}'):g}"


def test_every_protocol_has_one_row_and_every_row_a_protocol() -> None:
    assert len(ROWS) == len(table())
    assert set(ROWS) == {info.name for _, info in USED}
    for name, row in ROWS.items():
        assert row.roles.split(", ") == [kind for kind in PROTOCOLS if name in PROTOCOLS[kind]], name
        assert "" not in row, name


@pytest.mark.parametrize(("kind", "info"), USED, ids=lambda value: getattr(value, "name", value))
def test_a_row_says_what_the_code_does(kind: Kind, info: ProtocolInfo) -> None:
    row = ROWS[info.name]
    assert row.line == f"{info.baud} 8{info.parity[0].upper()}1"
    if kind == "gradienter":
        assert row.law.startswith(info.law or "not documented")
        sigma = figure(models.tilt_sigma_deg(info.name))  # type: ignore[arg-type]
        assert re.search(rf"(?<![\d.]){sigma} deg", row.sigma), sigma
    if kind == "compass":
        for value in {info.sigma_deg or models.HEADING_SIGMA_DEG, info.tilted_sigma_deg or info.sigma_deg}:
            assert value is None or re.search(rf"(?<![\d.]){figure(value)} deg", row.sigma), value
    lag = figure(info.lag_s)
    assert re.search(rf"(?<![\d.]){lag} s", row.lag), lag
    assert (row.sent == "nothing") == (info.dialogue is None)


def test_one_device_is_the_same_under_each_of_its_roles() -> None:
    seen: dict[str, ProtocolInfo] = {}
    for _, info in USED:
        first = seen.setdefault(info.name, info)
        assert (first.decoder, first.dialogue, first.baud, first.parity) == (
            info.decoder,
            info.dialogue,
            info.baud,
            info.parity,
        )

"""The sample configuration: every key there is, at its default, understood as it stands and with everything on."""

from __future__ import annotations

import re
import tomllib
import typing
from typing import Any, Literal

import msgspec
import pytest

from companion.config import parse
from companion.config.sections import Config, Imu
from companion.installation import install as installing

SAMPLE = installing.content(installing.SAMPLE).decode()
EVERYTHING = re.sub(r"^#(?=[a-z\[])", "", SAMPLE, flags=re.MULTILINE)
"""With every key that is commented out switched on."""


def sections(owner: type[msgspec.Struct]) -> dict[str, type[msgspec.Struct]]:
    """The sections by name, and of lists of sections what they hold."""

    def inner(annotation: Any) -> type[msgspec.Struct] | None:
        if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
            return annotation
        return next((found for each in typing.get_args(annotation) if (found := inner(each))), None)

    hints = typing.get_type_hints(owner)
    return {name: section for name in hints if (section := inner(hints[name]))}


def shown_for(section: str, tables: Any) -> dict[str, list[Any]]:
    """Every value that the sample shows for each key of a section."""
    shown: dict[str, list[Any]] = {}
    for table in tables[section] if isinstance(tables[section], list) else [tables[section]]:
        for key, value in table.items():
            shown.setdefault(key, []).append(value)
    return shown


def test_it_is_understood_as_it_stands_and_with_everything_on() -> None:
    as_it_stands = parse(SAMPLE, "sample")
    assert as_it_stands.gradienter is None
    assert as_it_stands.mqtt is None
    # Certificates are for TLS alone, which is off by default.
    everything = parse(EVERYTHING.replace("tls = false", "tls = true"), "sample")
    assert None not in [getattr(everything, name) for name in Config.__struct_fields__]


@pytest.mark.parametrize("section", sections(Config))
def test_every_key_is_there_with_its_default_and_a_word(section: str) -> None:
    kind = sections(Config)[section]
    shown = shown_for(section, tomllib.loads(EVERYTHING))
    assert shown.keys() == set(kind.__struct_fields__)
    for field in msgspec.structs.fields(kind):
        if field.default not in (msgspec.NODEFAULT, None):
            default = list(field.default) if isinstance(field.default, tuple) else field.default
            assert default in shown[field.name], field.name
    # What is commented out in a section that is on must be its default, or switching it on would change something.
    on = parse(SAMPLE, "sample")
    if getattr(on, section) is not None and kind is not Imu:
        active = tomllib.loads(SAMPLE)[section]
        for field in msgspec.structs.fields(kind):
            if field.name not in active and field.default is not None:
                default = list(field.default) if isinstance(field.default, tuple) else field.default
                assert shown[field.name] == [default], field.name


def choices(annotation: Any) -> set[Any]:
    if typing.get_origin(annotation) is Literal:
        return set(typing.get_args(annotation))
    return {choice for each in typing.get_args(annotation) for choice in choices(each)}


def test_every_choice_is_named() -> None:
    comments = "\n".join(line for line in SAMPLE.splitlines() if line.startswith("# "))
    for kind in sections(Config).values():
        for name, annotation in typing.get_type_hints(kind, include_extras=True).items():
            for choice in choices(annotation):
                assert f'"{choice}"' in comments, f"{kind.__name__}.{name}"

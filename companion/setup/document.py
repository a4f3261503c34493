"""Editor for the text of the configuration file: sets values, preserves comments, uncomments lines and sections."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from companion.errors import CompanionError

Table = dict[str, Any]

_HEADER: Final = re.compile(r"(?P<off>#?)(?P<list>\[)?\[(?P<name>\w+)\]\]?\s*(?:#.*)?$")
_KEY: Final = re.compile(r"(?:(?P<off>#)|\s*)(?P<key>\w+)\s*=.*?(?P<comment>\s+#[^\"']*)?$")


@dataclass
class _Block:
    name: str
    on: bool
    lines: list[str]

    def last_key(self) -> int:
        keys = [index for index, line in enumerate(self.lines) if index and _KEY.match(line)]
        return keys[-1] if keys else 0

    def set(self, key: str, value: Any) -> None:
        """Set a key in this section of the file to a value; None: comment the key out."""
        places = [(index, match) for index, line in enumerate(self.lines) if (match := _KEY.match(line))]
        mine = sorted(
            ((match["off"] is not None, index, match) for index, match in places if match["key"] == key),
            key=lambda one: one[:2],
        )
        if value is None:
            for off, index, _ in mine:
                self.lines[index] = self.lines[index] if off else f"#{self.lines[index].lstrip()}"
        elif mine:
            _, index, match = mine[0]
            self.lines[index] = f"{key} = {toml(value)}{match['comment'] or ''}"
        else:
            self.lines.insert(self.last_key() + 1, f"{key} = {toml(value)}")


def toml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str | bool) else repr(value)


def render(text: str, wanted: Mapping[str, Any]) -> str:
    """Edit lines of a TOML text until its values equal `wanted`; raise CompanionError if that is impossible."""
    blocks = list(_blocks(text))
    now = tomllib.loads(text)
    for name, section in wanted.items():
        if isinstance(section, list):
            _set_list(blocks, name, now.get(name, []), section)
        else:
            _set_table(_section(blocks, name), now.get(name, {}), section)
    result = "\n".join(line for block in blocks for line in block.lines) + "\n"
    try:
        if tomllib.loads(result) == wanted:
            return result
    except tomllib.TOMLDecodeError:
        pass
    raise CompanionError("the file is not written line by line, so it cannot be changed line by line")


def _blocks(text: str) -> Iterator[_Block]:
    block = _Block("", on=False, lines=[])
    for line in text.rstrip("\n").split("\n"):
        if match := _HEADER.fullmatch(line):
            yield block
            block = _Block(match["name"], on=not match["off"], lines=[])
        block.lines.append(line)
    yield block


def _section(blocks: list[_Block], name: str) -> _Block:
    if (found := _first(blocks, name, on=True) or _switched_on(blocks, name)) is not None:
        return found
    blocks[-1].lines.append("")
    blocks.append(_Block(name, on=True, lines=[f"[{name}]"]))
    return blocks[-1]


def _first(blocks: Sequence[_Block], name: str, *, on: bool) -> _Block | None:
    return next((block for block in blocks if block.name == name and block.on == on), None)


def _switched_on(blocks: Sequence[_Block], name: str) -> _Block | None:
    if (block := _first(blocks, name, on=False)) is not None:
        block.on, block.lines[0] = True, block.lines[0].removeprefix("#")
    return block


def _set_list(blocks: list[_Block], name: str, now: Sequence[Table], wanted: Sequence[Table]) -> None:
    there = [block for block in blocks if block.name == name and block.on]
    for index, table in enumerate(wanted):
        if index < len(there):
            _set_table(there[index], now[index], table)
            continue
        # In the sample file, the commented table is for a device on a serial port, and is the last of its kind.
        block = _switched_on(blocks, name) if "port" in table else None
        _set_table(block or _behind(blocks, name), {}, table)


def _behind(blocks: list[_Block], name: str) -> _Block:
    last = max((index for index, block in enumerate(blocks) if block.name == name and block.on), default=-1)
    before = blocks[last]
    cut = before.last_key() + 1
    fresh = _Block(name, on=True, lines=[f"[[{name}]]", *before.lines[cut:]])
    before.lines[cut:] = [""]
    blocks.insert(last + 1 if last >= 0 else len(blocks), fresh)
    return fresh


def _set_table(block: _Block, now: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    for key in now.keys() - wanted.keys():
        block.set(key, None)
    for key, value in wanted.items():
        if key not in now or now[key] != value:
            block.set(key, value)

"""Spoken texts of ground stations: the first line of every text of NOTICE or worse.

That it is one line, and good news without figures, holds for whatever is filled in: test_statustext.py.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from companion.component.statustext import Severity, as_lines, to_ascii
from companion.messages import catalogue
from tests.support.messages import FILLED, ROOT, template_of

NO_FIRMWARE_YET = re.compile(r"\b(sigma|deg|mg|K|imu|accel|GNSS|EKF2?)\b|[=_%/]")
"""Abbreviations and names that nobody understands by ear."""


def spoken(source: str) -> set[tuple[Severity, str]]:
    """Severity and template of the texts that are said to be heard, where they stand in the function that says it."""
    tree = ast.parse(source)
    functions: list[ast.AST] = [
        node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    return {each for function in functions or [tree] for each in _said_in(function)}


def _said_in(function: ast.AST) -> Iterator[tuple[Severity, str]]:
    assigned: dict[str, list[ast.AST]] = {}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                assigned.setdefault(ast.unparse(target), []).append(node.value)
    for call in ast.walk(function):
        if not isinstance(call, ast.Call) or len(call.args) < 2:
            continue
        name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
        named = ast.unparse(call.args[0]).removeprefix("Severity.")
        severity = Severity.NOTICE if name == "prompt" else Severity.__members__.get(named)
        if severity is not None and severity <= Severity.NOTICE:
            for words in assigned.get(ast.unparse(call.args[1]), [call.args[1]]):
                yield from ((severity, text) for text in _texts(words) if " " in text.strip())


def _texts(words: ast.AST) -> Iterator[str]:
    """Templates in an expression; those of the catalogue for a call of `message`."""
    if isinstance(words, ast.Call) and ast.unparse(words.func) == "message":
        yield re.sub(r"\{[^}]*\}", FILLED, catalogue()[ast.literal_eval(words.args[0])].text)
        return
    yield from filter(None, [template_of(words)])
    for part in ast.iter_child_nodes(words):
        if not (isinstance(words, ast.JoinedStr) and isinstance(part, ast.Constant)):
            yield from _texts(part)


def unheard(severity: Severity, template: str) -> str | None:
    """Fault of the spoken line; None if it is good."""
    filled = re.sub(rf"{FILLED}(?= (mg|deg))", "2.5", template).replace(FILLED, "fc")
    line = as_lines(severity, to_ascii(filled))[0][1]
    if len(line.split()) < 2:
        return f"{line!r} tells nothing by itself"
    return f"{line!r} is nothing to hear" if NO_FIRMWARE_YET.search(line) else None


def test_every_text_that_is_spoken_is_a_line_to_be_heard() -> None:
    found = [each for path in (ROOT / "companion").rglob("*.py") for each in spoken(path.read_text("utf-8"))]
    assert len(found) > 25
    wrong = {text.replace(FILLED, "…"): why for severity, text in found if (why := unheard(severity, text)) is not None}
    assert not wrong

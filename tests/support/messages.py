"""Every line that the companion's code can say to people, as templates: read from the source, not from a run.

A template is a text of the program in which each value that is filled in is one `FILLED`. Every text of at
least two words counts, and every argument of the functions in `SPEAKERS`. `NOT_FOR_PEOPLE` and `ELSEWHERE` name the
exceptions. A new message is therefore found without being registered anywhere.
"""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILLED = "\0"

SPEAKERS = {"say", "_say", "prompt", "up", "_fault", "_words", "reset", "_void"}
"""Functions whose text arguments are messages, even of one word."""

NOT_FOR_PEOPLE = {
    # Mistakes of the program itself: they end in the row "internal error".
    "ValueError", "RuntimeError", "TypeError", "IllegalEventError", "exception",
    # What happens in the ordinary course of things, in the log.
    "debug", "info",
    # Command lines that cannot be read are answered at once, with what is allowed.
    "ArgumentTypeError",
    # What a request over MQTT found, and what is allowed.
    "unfit",
    # Expressions and templates of other tools.
    "compile", "Formatter", "JournalFormatter", "OneLineFormatter",
    # Reasons beside the parameters that `companion autopilot params` prints.
    "HeadingSetting",
    # Names of tasks.
    "create_task", "Thread",
    # Words to a database.
    "Column", "create_engine", "exec_driver_sql",
    # Statements of SQL.
    "execute", "executemany", "executescript",
}  # fmt: skip

ELSEWHERE = {
    "companion/messages": "titles of the catalogue",
    "companion/config": "every line names file, key, what was found and what is allowed; one row tells so",
    "companion/commands.py": "help of the command line, and of a field what was found and what is allowed",
    "companion/installation": "printed by commands that are run at home, with what to do",
    "companion/cli/profile.py": "the table and its notes: docs/profiles.md",
    "companion/estimation/machine.py": "labels of the diagram in docs/calibration.md",
    "companion/daemon/interfaces/headline.py": "the big word of page and monitor: docs/page.md has each",
    "companion/cli/monitor.py": "the frame of the monitor: docs/page.md",
    "companion/ground": "printed on the ground laptop, each with what to do: docs/ground_stations.md",
    "companion/report": "labels of pages; why none can be made: docs/report.md",
    "companion/fleet/acl.py": "lines of brokers' files; what is no aircraft and its user, with what is allowed",
    "companion/fleet/contract.py": "reasons in the table of what was rejected, with what was found and what is allowed",
    "companion/fleet/judgement.py": "what is said against sensors: docs/fleet.md",
    "companion/fleet/page.py": "labels of pages: docs/fleet.md",
    "companion/fleet/server.py": "answers to browsers; what of its options is wrong, with what is allowed",
    "companion/web": "answers to browsers that ask for the wrong thing; what people see is the page",
}
"""Rooms whose words need no row of their own, and why."""

HELP = {"_parser", "add_setup", "add_commands", "_add_log_options", "add_table_options", "error"}
"""Functions that build the command line: their words are its help."""

_WORD = re.compile(r"[A-Za-z]{2,}")
_REMEDY = re.compile(
    r"\b(?:set|restart|reboot|disarm|hold still|keep|calibrate|try again|undo again|wait|use|give|name its|say|remove"
    r"|replug|begin again|align|move away|learn|install|end it|make it|turn it|tilt it|look|allowed|wanted|mend|delete"
    r"|pip|sudo|check|again|hands off|done)\b|\?"
)
"""Words of a remedy. A text that has one is understood without docs/messages.md."""
_PROGRESS = re.compile(
    r"(?:working|writing|watching|waiting|reading|putting|checking|restarting|comparing|measuring|turned)\b"
)
"""Beginnings of a text that says what is being done."""
_UNITS = {"deg", "mg", "min", "Hz", "imu", "gyro", "accel", "http", "IMU", "baud", "is"}


@dataclass(frozen=True)
class Message:
    where: str
    template: str

    @functools.cached_property
    def _parts(self) -> list[str]:
        return re.split(rf"{FILLED}+", self.template)

    @functools.cached_property
    def _pattern(self) -> re.Pattern[str]:
        return re.compile(".*?".join(map(re.escape, self._parts)))

    def is_in(self, line: str) -> bool:
        """Return True where a line shows this message, with any values."""
        # Most lines lack most parts: finding that out first is 20 times as fast.
        return all(part in line for part in self._parts) and self._pattern.search(line) is not None

    def has(self, words: str) -> bool:
        """Return True where this message contains words of a document, in which … is a wildcard."""
        parts, shown = [part.strip() for part in words.split("…")], self.shown()
        return all(part in shown for part in parts) and re.search(".*?".join(map(re.escape, parts)), shown) is not None

    def explains_itself(self) -> bool:
        """Return True where the text names a remedy, the allowed values or the action, so that it needs no row."""
        return _REMEDY.search(self.template) is not None or _PROGRESS.match(self.template) is not None

    def shown(self) -> str:
        """The template as the documents may write it."""
        return self._shown

    @functools.cached_property
    def _shown(self) -> str:
        return re.sub(rf"{FILLED}+", "…", self.template)


def _parents(tree: ast.AST) -> dict[ast.AST, ast.AST]:
    return {child: parent for parent in ast.walk(tree) for child in ast.iter_child_nodes(parent)}


def template_of(node: ast.AST) -> str | None:
    """The template that a node is, with printf places and the parts of an f-string filled in."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"%(?:\.\d+)?[sdrgf](?![a-z])", FILLED, node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else FILLED for part in node.values)
    return None


def _callers(node: ast.AST, parents: dict[ast.AST, ast.AST]) -> Iterator[str]:
    """Names of the functions whose arguments a node is part of, innermost first."""
    while (parent := parents.get(node)) is not None and not isinstance(parent, ast.stmt):
        if isinstance(parent, ast.Call) and node is not parent.func:
            function = parent.func
            yield function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        node = parent


def _is_documentation(node: ast.AST, parents: dict[ast.AST, ast.AST]) -> bool:
    return isinstance(parents.get(node), ast.Expr)


def _is_help(node: ast.AST, parents: dict[ast.AST, ast.AST]) -> bool:
    while (parent := parents.get(node)) is not None:
        if isinstance(parent, ast.FunctionDef) and parent.name in HELP:
            return True
        node = parent
    return False


def _counts(template: str, callers: list[str]) -> bool:
    if any(caller in NOT_FOR_PEOPLE for caller in callers):
        return False
    words = [word for word in _WORD.findall(template) if word not in _UNITS]
    if SPEAKERS & set(callers[:1]):
        return bool(words)
    return len(words) >= 2 and " " in template.strip()


def in_source(source: str, where: str) -> list[Message]:
    tree = ast.parse(source)
    parents = _parents(tree)
    found = []
    for node in ast.walk(tree):
        template = template_of(node)
        if template is None or _is_documentation(node, parents) or isinstance(parents.get(node), ast.JoinedStr):
            continue
        if _is_help(node, parents):
            continue
        if _counts(template, list(_callers(node, parents))):
            # Backticks would end the code span that shows it.
            found.append(Message(f"{where}:{getattr(node, 'lineno', 0)}", template.strip().replace("`", "")))
    return found


def in_lua(source: str, where: str) -> list[Message]:
    """All messages of the arming script: texts of two words, outside of comments."""
    found = []
    for number, line in enumerate(source.splitlines(), 1):
        for text in re.findall(r'"([^"]*)"', line.split("--", 1)[0]):
            template = re.sub(r"%[-.\d]*[sdfg]", FILLED, text).strip()
            if _counts(template, []):
                found.append(Message(f"{where}:{number}", template))
    return found


def all_messages() -> list[Message]:
    """All messages, in the order of the files."""
    found: list[Message] = []
    for path in sorted((ROOT / "companion").rglob("*.py")):
        where = path.relative_to(ROOT).as_posix()
        if not any(where == room or where.startswith(f"{room}/") for room in ELSEWHERE):
            found += in_source(path.read_text(encoding="utf-8"), where)
    script = ROOT / "companion/lua/companion_arming.lua"
    found += in_lua(script.read_text(encoding="utf-8"), script.relative_to(ROOT).as_posix())
    return found

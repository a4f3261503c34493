"""Run the daemon's process up to its first heartbeat; then say on stdout what was imported, and end.

For processes: `python -m tests.support.first_heartbeat` is not meant, but `python -c CODE FILE`, with this CODE.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

CODE = """
import os, sys
from companion.daemon.__main__ import prepare
prepare()
from companion.links.mavlink.link import MavlinkLink

def first(self, message):
    assert message.get_type() == "HEARTBEAT", message
    import json
    print(json.dumps(sorted(before)), flush=True)
    os._exit(0)

MavlinkLink.send = lambda self, *what: (before.update(sys.modules), first(self, *what))
before = set()
from companion.daemon.process.service import main
sys.exit(main(*sys.argv[1:]))
"""


def modules_at_first_heartbeat(config: Path, environment: Mapping[str, str]) -> tuple[set[str], str]:
    """Names of all modules that were loaded by then, and what Python has written on stderr."""
    command = [sys.executable, "-X", "importtime", "-c", CODE, str(config)]
    ended = subprocess.run(command, env=dict(environment), capture_output=True, text=True, timeout=60.0, check=False)
    if not ended.stdout:
        raise RuntimeError(f"the companion sent no heartbeat:\n{ended.stderr[-2000:]}")
    return set(json.loads(ended.stdout)), ended.stderr

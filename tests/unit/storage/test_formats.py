"""Types at their first use in two threads at once."""

from __future__ import annotations

import subprocess
import sys

RACE = """
import sys, threading, types
sys.setswitchinterval(1e-6)
from companion.formats import decode
chain = "\\n".join(
    f"class C{k}(msgspec.Struct):\\n    a: 'C{k + 1} | None' = None\\n    b: 'list[C{k + 1}]' = []" for k in range(30)
)
for number in range(30):
    module = sys.modules[f"made{number}"] = types.ModuleType(f"made{number}")
    exec(f"import msgspec\\n{chain}\\nclass C30(msgspec.Struct):\\n    a: int = 1", module.__dict__)
    barrier = threading.Barrier(6)
    def first(kind=module.C0, barrier=barrier):
        barrier.wait()
        assert decode(b'{"b":[{"b":[{}]}]}', kind, None).b
    threads = [threading.Thread(target=first) for _ in range(6)]
    for each in threads: each.start()
    for each in threads: each.join()
"""


def test_two_threads_may_read_a_new_type_at_once() -> None:
    """In a process of its own: without the lock of `decode` it ends by a segmentation fault."""
    done = subprocess.run([sys.executable, "-c", RACE], capture_output=True, text=True, timeout=60.0, check=False)
    assert (done.returncode, done.stderr) == (0, "")

"""`python -m tests.campaign`: the table of faults and phases, from a seed."""

from __future__ import annotations

import argparse
import json
import os
import random
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from tests.campaign.catalogue import FAULTS
from tests.campaign.cell import Outcome, run_cell
from tests.campaign.fault import PHASES, Phase
from tests.campaign.table import as_json, as_markdown, as_text

SEED = 7


def _play(cell: tuple[str, Phase, int]) -> Outcome:
    name, phase, seed = cell
    return run_cell(FAULTS[name], phase, seed)


def play(cells: list[tuple[str, Phase, int]], jobs: int) -> Iterator[Outcome]:
    if jobs == 1 or len(cells) == 1:
        yield from map(_play, cells)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(_play, cells, chunksize=1)


def slice_of(seed: int, faults: int) -> list[tuple[str, Phase, int]]:
    """Draw so many faults by the seed, a share of each group, each in one phase in which it can strike."""
    chance, names = random.Random(seed), list(FAULTS)
    faults = min(faults, len(names))
    start = chance.random()
    taken = [names[int((k + start) * len(names) / faults)] for k in range(faults)]
    return [(name, chance.choice([p for p in PHASES if p not in FAULTS[name].not_in]), seed) for name in taken]


def _chosen(patterns: Iterable[str] | None) -> list[str]:
    if not patterns:
        return list(FAULTS)
    found = [name for name in FAULTS if any(part in (name, FAULTS[name].room) for part in patterns)]
    if not found:
        sys.exit(f"no such fault: {' '.join(patterns)}; there are: {' '.join(FAULTS)}")
    return found


def main() -> int:
    """Run what is asked for; 1 when a cell fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaign", description=__doc__)
    parser.add_argument("--seed", type=int, default=SEED, help=f"of everything (default {SEED})")
    parser.add_argument(
        "--only", action="append", metavar="FAULT", help="this fault, or all of a room (device, link ...)"
    )
    parser.add_argument("--phase", action="append", choices=PHASES, help="in this phase only")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="processes (default 2)")
    parser.add_argument("--json", metavar="FILE", help="write the outcomes there")
    parser.add_argument("--markdown", metavar="FILE", help="write the table there, between its marks")
    parser.add_argument("--story", action="store_true", help="tell what happened in each cell")
    parser.add_argument("--slice", type=int, metavar="N", help="only N faults, each in one phase, chosen by the seed")
    parser.add_argument("--progress", action="store_true", help="tell of each cell as it ends")
    parser.add_argument("--hour", action="store_true", help="an hour of operation with random faults instead")
    parser.add_argument("--fleet", action="store_true", help="faults between a fleet and its database instead")
    parser.add_argument("--minutes", type=float, default=60.0, help="with --hour: so long")
    options = parser.parse_args()
    if options.hour:
        from tests.campaign.hour import main as hour

        return hour(options.seed, options.minutes, options.json)
    if options.fleet:
        from tests.campaign.fleet import main as fleet

        return fleet(options.seed, options.only)
    cells = [(name, phase, options.seed) for name in _chosen(options.only) for phase in options.phase or PHASES]
    if options.slice is not None:
        cells = slice_of(options.seed, options.slice)
    began_s, done = time.monotonic(), []
    for outcome in play(cells, options.jobs):
        done.append(outcome)
        if options.json:  # at once: what a long run has found so far is worth keeping
            Path(options.json).write_text(json.dumps(as_json(done), indent=1) + "\n", encoding="utf-8")
        if options.progress:
            print(f"{len(done)}/{len(cells)} {outcome.fault} {outcome.phase}: {outcome.verdict}", file=sys.stderr)
        if outcome.problems:
            print(f"FAIL {outcome.fault} in {outcome.phase} ({outcome.variant})", file=sys.stderr)
            for words in outcome.problems:
                print(f"     {words}", file=sys.stderr)
            again = f"--only {outcome.fault} --phase {outcome.phase} --seed {outcome.seed}"
            print(f"     again: python -m tests.campaign {again}", file=sys.stderr)
        if options.story:
            print(f"{outcome.fault} in {outcome.phase} ({outcome.variant}, {outcome.cpu_s:.1f} s): {outcome.verdict}")
            print("\n".join(f"  {line}" for line in outcome.story))
    print(as_text(done, options.seed))
    print(f"{time.monotonic() - began_s:.0f} s, {sum(outcome.cpu_s for outcome in done):.0f} s of processor time")
    if options.markdown:
        as_markdown(done, options.seed, Path(options.markdown))
    return 1 if any(outcome.problems for outcome in done) else 0


if __name__ == "__main__":
    sys.exit(main())

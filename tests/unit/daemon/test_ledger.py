"""`WriteJournal.transaction`: what becomes of a write, by how its block ends; compared with what lies on the disk."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from companion.autopilot.parameters.change import NothingWrittenError, WriteFailedError
from companion.daemon.offsets.journal import WriteJournal
from companion.errors import AutopilotError, StorageError
from companion.storage.changes import Changed, ChangeLog, ChangeSet, Undoable
from companion.storage.state import StateFile

pytestmark = pytest.mark.real_clock

NAMES = ("INS_GYROFFS_X", "INS_GYROFFS_Y")
OLD = ChangeSet(1, (Changed(NAMES[0], before=0.001, after=0.002),))
WIDER = ChangeSet(1, (*OLD.changes, Changed(NAMES[1], before=0.003, after=None)))

HALF_BACK = WriteFailedError("no answer", "silent", {}, NAMES[:1])
ALL_BACK = WriteFailedError("refused", "read-only", {}, ())
NOTHING = NothingWrittenError("nothing is written: the aircraft is armed")


class TornDown(BaseException):
    """None of those that anybody expects."""


Block = Callable[[WriteJournal], Awaitable[None]]


def on_disk(folder: Path, name: str = "journal.json") -> ChangeSet | None:
    found: ChangeSet | None = StateFile(folder / name, ChangeSet).read()
    return found


def raises(error: BaseException) -> Block:
    async def block(journal: WriteJournal) -> None:
        raise error

    return block


async def wordless(journal: WriteJournal) -> None:
    """Ignore the end of the transaction."""


async def done_and_then(journal: WriteJournal) -> None:
    await journal.done(OLD)
    raise AutopilotError("after the end")


async def undone_and_then(journal: WriteJournal) -> None:
    await journal.undone()
    raise WriteFailedError("no answer", "after the end", {}, NAMES[:1])


class LedgerDisk:
    """Runs the ledger's calls at once, and refuses what it shall."""

    def __init__(self) -> None:
        self.refuses: set[str] = set()
        """Operations that fail: "write", "clear"."""

    async def offload(self, function: Callable[..., Any], *arguments: Any) -> Any:
        await asyncio.sleep(0)
        if function.__name__ in self.refuses:
            raise StorageError(f"{function.__name__}: no space left")
        return function(*arguments)


def opened(folder: Path, disk: LedgerDisk | None = None) -> WriteJournal:
    journal = WriteJournal(ChangeLog(folder), (disk or LedgerDisk()).offload)
    journal.load()
    return journal


async def end_of(journal: WriteJournal, block: Block) -> BaseException | None:
    async def write() -> None:
        async with journal.transaction(OLD):
            await block(journal)

    (found,) = await asyncio.gather(write(), return_exceptions=True)
    return found


@pytest.mark.parametrize(
    ("block", "over"),
    [
        (raises(ALL_BACK), True),
        (raises(NOTHING), True),
        (raises(HALF_BACK), False),
        (raises(AutopilotError("no heartbeat")), False),
        (raises(StorageError("full")), False),
        (raises(asyncio.CancelledError()), False),
        (raises(TornDown()), False),
        (wordless, False),
        (done_and_then, True),
        (undone_and_then, True),
    ],
    ids=[
        "old values restored", "nothing written", "left changed", "another error",
        "the disk", "cancelled", "torn down", "no word", "an error after done", "an error after undone",
    ],
)  # fmt: skip
async def test_a_write_is_over_when_it_is_known_to_be_and_else_the_menders(
    tmp_path: Path, block: Block, over: bool
) -> None:
    journal = opened(tmp_path)
    await end_of(journal, block)
    assert journal.pending is not over
    assert on_disk(tmp_path) == (None if over else OLD)
    if not over:
        assert await asyncio.wait_for(journal.interrupted(), 30.0) == OLD
        await journal.undone()
        assert not journal.pending
        assert on_disk(tmp_path) is None
    assert await end_of(journal, raises(ALL_BACK)) is ALL_BACK  # the next one may write


@pytest.mark.parametrize(
    ("block", "kept"),
    [(raises(ALL_BACK), True), (raises(NOTHING), True), (WriteJournal.undone, False), (raises(HALF_BACK), False)],
    ids=["old values restored", "nothing written", "undone", "left changed"],
)
async def test_an_undo_that_changes_nothing_keeps_its_step_also_over_a_restart(
    tmp_path: Path, block: Block, kept: bool
) -> None:
    journal = opened(tmp_path)
    await end_of(journal, lambda journal: journal.done(OLD))
    await end_of(journal, block)
    if journal.pending:  # the recovery brings the undo to its end
        assert journal.is_undoable(OLD)
        await journal.undone()
    steps = (OLD,) if kept else ()
    assert journal.steps(1) == opened(tmp_path).steps(1) == steps
    assert (tmp_path / "undo-1.json").exists() is kept
    assert on_disk(tmp_path) is None


def test_an_undo_of_two_writes_takes_both_steps_off_a_value_that_was_learned_in_between() -> None:
    name = "INS_ACC_VRFB_Z"
    first, second = (ChangeSet(1, (Changed(name, *values),)) for values in ((0.2, 0.15), (0.18, 0.17)))
    (joined,) = second.after(first).changes
    assert joined.before == pytest.approx(0.23)
    assert joined.after == 0.17
    (replaced,) = ChangeSet(1, (Changed(NAMES[0], 0.18, 0.17),)).after(OLD).changes
    assert replaced.before == 0.18


async def test_the_old_values_are_on_disk_before_the_block_and_grow_with_it(tmp_path: Path) -> None:
    journal = opened(tmp_path)
    async with journal.transaction(OLD):
        assert on_disk(tmp_path) == OLD
        assert not journal.pending
        await journal.update_pending(WIDER)
        assert on_disk(tmp_path) == WIDER
        await journal.done(WIDER)
    assert not journal.pending
    assert on_disk(tmp_path) is None
    assert ChangeLog(tmp_path).undo_of(1).read() == Undoable(1, (WIDER,))
    assert journal.steps(1) == (WIDER,)


async def test_nothing_is_written_whose_old_values_cannot_be_kept(tmp_path: Path) -> None:
    disk, called = LedgerDisk(), []
    journal = opened(tmp_path, disk)
    disk.refuses = {"write"}

    async def block(journal: WriteJournal) -> None:
        called.append(journal)

    assert isinstance(await end_of(journal, block), StorageError)
    assert not called
    assert not journal.pending


@pytest.mark.parametrize("refused", ["write", "clear"])
async def test_a_disk_that_refuses_the_end_leaves_the_write_to_the_mender_and_nothing_to_undo(
    tmp_path: Path, refused: str
) -> None:
    disk = LedgerDisk()
    journal = opened(tmp_path, disk)

    async def block(journal: WriteJournal) -> None:
        disk.refuses = {refused}
        await journal.done(OLD)

    assert isinstance(await end_of(journal, block), StorageError)
    assert journal.pending
    assert on_disk(tmp_path) == OLD
    disk.refuses = set()
    await journal.undone()
    assert not journal.undoable
    assert not opened(tmp_path).undoable


async def test_a_second_write_does_not_take_the_place_of_one_that_is_open_or_was_interrupted(tmp_path: Path) -> None:
    journal = opened(tmp_path)
    async with journal.transaction(OLD):
        with pytest.raises(AutopilotError, match="restoring old values"):
            async with journal.transaction(WIDER):
                raise AssertionError("written over")
        assert not journal.pending
        assert on_disk(tmp_path) == OLD
    assert "restoring old values" in str(await end_of(journal, wordless)), "interrupted"
    assert on_disk(tmp_path) == OLD
    again = opened(tmp_path)
    assert await asyncio.wait_for(again.interrupted(), 30.0) == OLD, "of a daemon that died"

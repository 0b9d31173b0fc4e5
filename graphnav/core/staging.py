"""Results are written completely or not at all, whatever stops the writing: Ctrl-C, SIGTERM, a full disk, an error."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from graphnav.core.errors import ConfigError, PartlyWrittenError


@contextmanager
def stage_results(folder: Path, read: Iterable[str | Path] = ()) -> Iterator[Path]:
    """A folder to write into; its files move to `folder` at the end, or are removed if the end is not reached.

    It lies inside `folder`, so that moving is renaming; `folder` is created if need be, and removed again if it stays
    empty. A file of the same name is replaced in one step. After a `PartlyWrittenError` the files written so far are
    kept, and no older file remains in place of one that is missing. No file that was `read` is replaced.

    Raises
    ------
    ConfigError
        If it cannot be written, as when the disk is full, or would be in place of one that was read.
    """
    made = _list_missing(folder)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        part = Path(tempfile.mkdtemp(prefix=".graphnav-", dir=folder))
        try:
            failed = None
            try:
                yield part
            except PartlyWrittenError as error:
                failed = error
            every = {file: folder / file.relative_to(part) for file in sorted(part.rglob("*")) if file.is_file()}
            keep_inputs(folder, every.values(), read)
            with defer_interrupts():
                for file, target in every.items():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    os.replace(file, target)
                for file in () if failed is None else failed.missing:
                    (folder / file.relative_to(part)).unlink(missing_ok=True)
            if failed is not None:
                raise failed
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        if error.filename and not Path(error.filename).resolve().is_relative_to(folder.resolve()):
            raise  # a file that was to be read
        raise ConfigError(
            f"-o {folder}: cannot be written ({error.strerror or error}); what was there before is unchanged",
            key="output.cannot_write",
        ) from None
    finally:
        for path in made:
            with suppress(OSError):  # not empty
                path.rmdir()


def keep_inputs(folder: Path, targets: Iterable[Path], read: Iterable[str | Path]) -> None:
    """Refuse to write files into `folder` in place of some that are read.

    Raises
    ------
    ConfigError
        Naming the first.
    """
    inputs = {Path(one).resolve() for one in read}
    for target in targets:
        if target.resolve() in inputs:
            raise ConfigError(
                f"-o {folder}: {target} is read, and would be replaced; name another folder", key="output.is_input"
            )


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Defer Ctrl-C and SIGTERM to the end of this context, which should be short."""
    # only the main thread may set handlers, and only it is interrupted
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []
    before = {
        what: signal.signal(what, lambda number, _: waiting.append(number)) for what in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for what, handler in before.items():
            signal.signal(what, handler)
    for number in waiting:
        signal.raise_signal(number)


def _list_missing(folder: Path) -> list[Path]:
    """The missing folders on the way to `folder`, innermost first."""
    return [path for path in (folder, *folder.parents) if not path.exists()]


def resolve_final_path(files: list[Path], part: Path, folder: Path) -> list[Path]:
    """Where files of a staged folder are moved to; others stay where they are."""
    return [folder / file.relative_to(part) if file.is_relative_to(part) else file for file in files]

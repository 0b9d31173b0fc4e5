"""Results appear whole or not at all, whatever stops the writing: Ctrl-C, a full disk, an error."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from graphnav.core.errors import ConfigError, PartlyWrittenError


@contextmanager
def stage_results(folder: Path) -> Iterator[Path]:
    """A folder to write into, whose files move to `folder` at the end; if that is not reached, nothing of them is left.

    It lies inside `folder`, which is made if need be and taken away again if nothing came of it, so that moving is
    renaming. A file that was there under the same name is replaced in one step.

    What ends with a `PartlyWrittenError` keeps what it has written, and nothing older of what it has not.

    Raises
    ------
    ConfigError
        If it cannot be written, as when the disk is full.
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
            with defer_interrupts():
                for file in sorted(path for path in part.rglob("*") if path.is_file()):
                    target = folder / file.relative_to(part)
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
            raise  # of a file that was to be read
        raise ConfigError(
            f"-o {folder}: cannot be written ({error.strerror or error}); what was there before is unchanged",
            key="output.cannot_write",
        ) from None
    finally:
        for path in made:
            with suppress(OSError):  # not empty: something came of it
                path.rmdir()


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Ctrl-C waits until the end of what is inside, which is to be short."""
    if threading.current_thread() is not threading.main_thread():  # which alone may say so, and alone is interrupted
        yield
        return
    waiting: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: waiting.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if waiting:
        raise KeyboardInterrupt


def _list_missing(folder: Path) -> list[Path]:
    """The folders on the way to `folder` that are not there, innermost first."""
    return [path for path in (folder, *folder.parents) if not path.exists()]


def final_path(files: list[Path], part: Path, folder: Path) -> list[Path]:
    """Where files of a staged folder are in the end; others stay where they are."""
    return [folder / file.relative_to(part) if file.is_relative_to(part) else file for file in files]

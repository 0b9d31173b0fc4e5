"""The command `online`: smooth during the drive, from a replayed recording or a live source of lines.

Settled states are on disk at once. Ctrl-C, a crash or a full disk lose none of them; --resume continues.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from graphnav.app.cli_options import (
    AllowOutside,
    Config,
    Fire,
    FormatOption,
    ProfileOption,
    Quiet,
    Topic,
    choose_detectors,
)
from graphnav.app.talk import Interrupted, say, warn
from graphnav.core.errors import ConfigError

if TYPE_CHECKING:
    from graphnav.config import Settings
    from graphnav.online.session import Session
    from graphnav.recording import Recording

LONGEST_LINE = 1 << 20  # bytes of a line
TICK = 0.5  # s between updates of the view, and of each wait for a source

commands = typer.Typer()


@commands.command(
    epilog="\b\nExamples:\n  graphnav online data/tokyo --speed 10 -o out/online\n"
    "  graphnav online tcp:5005 -o out/live\n"
    "  graphnav online data/tokyo --send --speed 1 | graphnav online - -o out/live"
)
def online(
    source: Annotated[
        str,
        typer.Argument(metavar="SOURCE", help="A recording; lines: a file of them, - for standard input, tcp:PORT."),
    ],
    out: Annotated[Path | None, typer.Option("-o", "--out", metavar="OUT", help="Folder to write into.")] = None,
    speed: Annotated[
        float,
        typer.Option("--speed", metavar="X", help="Speed of a replay in times real time; 0: as fast as possible."),
    ] = 0.0,
    lag: Annotated[
        float | None,
        typer.Option(
            "--lag", metavar="S", help="Lag of the smoothed states: the span of later measurements that each includes."
        ),
    ] = None,
    engine: Annotated[
        str | None, typer.Option("--engine", metavar="NAME", help="Smoother: window (default), or GTSAM's isam2.")
    ] = None,
    detectors: Fire = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in OUT.")] = False,
    send: Annotated[
        bool, typer.Option("--send", help="Print the recording as lines of the protocol instead of smoothing it.")
    ] = False,
    profile: ProfileOption = None,
    config: Config = None,
    format: FormatOption = None,
    topic: Topic = None,
    allow_outside: AllowOutside = False,
    quiet: Quiet = False,
) -> None:
    """Filter and smooth in real time: a replay, or a live source.

    A live source sends lines, as docs/online.md describes.
    """
    from graphnav.app.outputs import check_output_folder
    from graphnav.config import read_settings
    from graphnav.online.session import Session
    from graphnav.recording.formats import read

    stored = _holds_lines(Path(source))
    live = source == "-" or source.startswith("tcp:") or stored
    if not speed >= 0.0:
        raise ConfigError(f"--speed {speed:g}: must be a number from 0 on", key="option.value")
    if send and live:
        raise ConfigError(f"{source}: --send prints a recording; this gives lines already", key="option.not_here")
    for option, value in (("--format", format), ("--topic", topic), ("--speed", speed)):
        if live and value:
            raise ConfigError(f"{option}: is of recordings; {source} gives lines", key="option.not_here")
    if send:
        _send(read(source, topic or (), allow_outside, format), speed)
        return
    settings = choose_detectors(_override(read_settings(config, profile), lag, engine), detectors)
    if resume and out is None:
        raise ConfigError("--resume: name the folder to continue in: -o OUT", key="option.missing")
    folder = None if out is None else check_output_folder(out)
    recording = None if live else read(source, topic or (), allow_outside, format)
    session = Session(settings, source, folder, resume, recording)
    shown = LiveView(session, quiet)
    with StopRequest() as asked:
        try:
            if stored:
                follow(session, _read_chunks(Path(source)), shown, asked)
            elif live:
                follow(session, read_standard_input() if source == "-" else read_connections(source), shown, asked)
            else:
                process_recording(session, Pace(speed), shown, asked)
            if not asked:
                session.finish()
            elif not session.done:
                session.stop()
        finally:
            session.close()
            shown.finish()
            if quiet:
                warn(session.list_doubts())
    if asked and not session.done:
        raise Interrupted("interrupted" + (f"; go on with --resume -o {folder}" if folder else ""))
    session.require_result()


def _holds_lines(path: Path) -> bool:
    """Whether a file begins as a live source does."""
    from graphnav.online.lines import PROTOCOL

    with suppress(OSError, ValueError), path.open("rb") as file:
        return file.read(len(PROTOCOL)) == PROTOCOL.encode()
    return False


def _read_chunks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while chunk := file.read(1 << 16):
            yield chunk


def _override(settings: Settings, lag: float | None, engine: str | None) -> Settings:
    """The settings, overridden by the options given."""
    from graphnav.config import parse_settings

    if lag is not None and not lag >= 1.0:
        raise ConfigError(f"--lag {lag:g}: must be at least 1 s", key="option.value")
    if engine is not None and engine not in ("window", "isam2"):
        raise ConfigError(f"--engine {engine}: must be window or isam2", key="option.value")
    typed = {key: value for key, value in (("lag", lag), ("engine", engine)) if value is not None}
    return parse_settings(settings.model_dump() | {"solver": settings.solver.model_dump() | typed})


def _send(recording: Recording, speed: float) -> None:
    """Print a recording's lines, as its sensors would have sent them."""
    from graphnav.online.lines import END, format_lines

    pace = Pace(speed)
    for t, line in format_lines(recording):
        pace.wait(t)
        say(line, flush=speed > 0 or line == END)


def process_recording(session: Session, pace: Pace, shown: LiveView, asked: StopRequest) -> None:
    """Process the rows of a recording as they become due."""
    for row in session.rows[session.taken :]:
        pace.wait(row[1], shown.update, asked)
        if asked:
            return
        session.add(row)
        shown.update_if_due()


class StopRequest:
    """Whether Ctrl-C or a SIGTERM requested an end; checked between two rows, where the smoother's state is
    consistent.
    """

    def __init__(self) -> None:
        self.so = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        self._before = {what: signal.signal(what, self._ask) for what in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        for what, handler in self._before.items():
            signal.signal(what, handler)

    def __bool__(self) -> bool:
        return self.so

    def _ask(self, _: int, frame: FrameType | None) -> None:
        if self.so:
            raise KeyboardInterrupt  # requested twice: ends at once, --resume continues from the checkpoint on disk
        self.so = True


def follow(session: Session, chunks: Iterator[bytes | None], shown: LiveView, asked: StopRequest) -> None:
    """Process lines until the source ends or an end is requested.

    b"" means that nothing arrived for a while, None that the sender has disconnected and its last line may be cut.
    """
    rest, last_row = b"", time.monotonic()
    for chunk in chunks:
        if chunk is None:
            rest = b""  # a line cut within its last number would still parse as a row
        elif chunk:
            *whole, rest = (rest + chunk).split(b"\n")
            rest = rest[:LONGEST_LINE]  # a line without an end is no row, and is reported as one when it does end
            whole = [line[:LONGEST_LINE] for line in whole]
            session.add_lines([line.decode("utf-8", "replace") for line in whole], asked.__bool__)
            last_row = time.monotonic()
        shown.update_if_due(time.monotonic() - last_row)
        if session.done or asked:
            return


def read_standard_input() -> Iterator[bytes]:
    while True:
        if select.select([sys.stdin.fileno()], [], [], TICK)[0]:
            chunk = os.read(sys.stdin.fileno(), 1 << 16)
            if not chunk:
                return
            yield chunk
        else:
            yield b""


def read_connections(source: str) -> Iterator[bytes | None]:
    """The lines of clients, one client after the other; a client that disconnects may reconnect."""
    port = source.removeprefix("tcp:")
    if not (port.isascii() and port.isdigit() and len(port) < 6 and int(port) < 1 << 16):
        raise ConfigError(
            f"{source}: cannot listen there: a port is a number from 0 to 65535", key="online.cannot_listen"
        )
    try:
        server = socket.create_server(("127.0.0.1", int(port)))
    except OSError as error:
        raise ConfigError(f"{source}: cannot listen there ({error.strerror})", key="online.cannot_listen") from None
    with server:
        while True:
            if not select.select([server], [], [], TICK)[0]:
                yield b""
                continue
            client, _ = server.accept()
            with client:
                while True:
                    if not select.select([client], [], [], TICK)[0]:
                        yield b""
                        continue
                    try:
                        chunk = client.recv(1 << 16)
                    except OSError:
                        chunk = b""
                    if not chunk:
                        yield None
                        break
                    yield chunk


class Pace:
    """Waits until a row is due at a multiple of real time."""

    def __init__(self, speed: float) -> None:
        self.speed, self.began, self.first = speed, time.monotonic(), float("nan")

    def wait(self, t: float, meanwhile: Callable[[], None] | None = None, asked: StopRequest | None = None) -> None:
        if self.speed <= 0.0:
            return
        if self.first != self.first:
            self.first, self.began = t, time.monotonic()
        while (ahead := (t - self.first) / self.speed - (time.monotonic() - self.began)) > 0.0:
            time.sleep(min(ahead, TICK))
            if asked:
                return
            if meanwhile is not None and ahead > TICK:
                meanwhile()


class LiveView:
    """The live view: a table that stays in place on a terminal, otherwise a line from time to time."""

    def __init__(self, session: Session, quiet: bool) -> None:
        self.session, self.quiet, self.next = session, quiet, 0.0
        self.live: Any = None
        self.last = ""
        if not quiet and sys.stdout.isatty():
            from rich.live import Live

            self.live = Live(auto_refresh=False)
            self.live.start()

    def update_if_due(self, silent: float = 0.0) -> None:
        if not self.quiet and time.monotonic() >= self.next:
            self.update(silent)

    def update(self, silent: float = 0.0) -> None:
        if self.quiet:
            return
        from graphnav.online.view import view

        lines = view(self.session, silent)
        if self.live is None:
            self.next = time.monotonic() + 10.0 * TICK
            text = "; ".join(f"{label}: {value}" for label, value in lines)
            if text != self.last:
                say(text)
            self.last = text
            return
        from rich.table import Table

        self.next = time.monotonic() + TICK
        table = Table(show_header=False, box=None)
        for label, value in lines:
            table.add_row(label, value)
        self.live.update(table, refresh=True)

    def finish(self) -> None:
        self.update()
        if self.live is not None:
            self.live.stop()

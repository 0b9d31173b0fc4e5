"""Smooth while the drive happens: a recording replayed, or a live source of lines (docs/online.md).

    python scripts/online.py ../shared/data/oracle_drive --speed 10 -o out/online
    python scripts/online.py ../shared/data/oracle_drive --send --speed 5 | python scripts/online.py - -o out/live
    python scripts/online.py tcp:5005 -o out/live

RECORDING is what graphnav smooth takes; '-' reads lines from standard input, tcp:PORT from whoever connects there.
What has settled is on disk at once. Ctrl-C, a crash or a full disk lose none of it; --resume goes on from there.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from graphnav.cli import BAD_INPUT, INTERRUPTED
from graphnav.config import Settings, read_settings
from graphnav.errors import ConfigError, GraphnavError
from graphnav.formats import read
from graphnav.online.lines import lines_of
from graphnav.online.session import Session
from graphnav.online.view import view
from graphnav.outputs import output_folder

LONGEST = 1 << 20  # bytes of a line
TICK = 0.5  # s between views, and of waiting for a source


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", metavar="RECORDING", help="a recording, '-' or tcp:PORT")
    parser.add_argument("-o", "--out", type=Path, help="folder to write into")
    parser.add_argument("--speed", type=float, default=0.0, help="times real time of a replay; 0: as fast as it goes")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in OUT")
    parser.add_argument("--send", action="store_true", help="print the recording as lines instead of smoothing it")
    parser.add_argument("--config", type=Path, help="settings, TOML")
    parser.add_argument("--lag", type=float, help="s of future that a settled state has seen")
    parser.add_argument(
        "--allow-outside", action="store_true", help="read what RECORDING names outside its folder, too"
    )
    parser.add_argument("--quiet", action="store_true", help="no view")
    options = parser.parse_args()
    try:
        return send(options) if options.send else smooth(options)
    except GraphnavError as error:
        print(f"online: {error}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return INTERRUPTED


def send(options: argparse.Namespace) -> int:
    """Print a recording's lines, as its sensors would have sent them."""
    pace = Pace(options.speed)
    for t, line in lines_of(read(options.source, options.allow_outside)):
        pace.wait(t)
        print(line, flush=options.speed > 0)
    return 0


def smooth(options: argparse.Namespace) -> int:
    settings = Settings() if options.config is None else read_settings(options.config)
    if options.lag is not None:
        if not options.lag >= 1.0:
            raise ConfigError(f"--lag {options.lag:g}: must be at least 1 s")
        solver = settings.solver.model_copy(update={"lag": options.lag})
        settings = settings.model_copy(update={"solver": solver})
    if options.resume and options.out is None:
        raise ConfigError("--resume: say which folder to go on in: -o OUT")
    folder = None if options.out is None else output_folder(options.out)
    live = options.source == "-" or options.source.startswith("tcp:")
    recording = None if live else read(options.source, options.allow_outside)
    session = Session(settings, options.source, folder, options.resume, recording)
    shown, asked = Shown(session, options.quiet), Asked()
    try:
        if live:
            follow(session, standard_input() if options.source == "-" else connections(options.source), shown, asked)
        else:
            pace = Pace(options.speed)
            for row in session.rows[session.taken :]:
                pace.wait(row[1], shown.update, asked)
                if asked:
                    break
                session.add(row)
                shown.now_and_then()
        if not asked:
            session.finish()
        elif not session.done:
            session.stop()
    finally:
        session.close()
        shown.last()
    if asked and not session.done:
        print("online: interrupted" + (f"; go on with --resume -o {folder}" if folder else ""), file=sys.stderr)
        return INTERRUPTED
    return 0


class Asked:
    """Whether Ctrl-C or a SIGTERM asked to end: between two rows, where the smoother is whole."""

    def __init__(self) -> None:
        self.so = False
        for what in (signal.SIGINT, signal.SIGTERM):
            signal.signal(what, self._ask)

    def __bool__(self) -> bool:
        return self.so

    def _ask(self, *_: object) -> None:
        if self.so:
            raise KeyboardInterrupt  # asked twice: at once, from the checkpoint on disk
        self.so = True


def follow(session: Session, chunks: Iterator[bytes], shown: Shown, asked: Asked) -> None:
    """Take in lines until the source ends or says so; b"" means that nothing came for a while."""
    rest, heard = b"", time.monotonic()
    for chunk in chunks:
        if chunk:
            *whole, rest = (rest + chunk).split(b"\n")
            rest = rest[:LONGEST]  # what never ends is no row, and told as such when it does
            whole = [line[:LONGEST] for line in whole]
            session.add_lines([line.decode("utf-8", "replace") for line in whole], asked.__bool__)
            heard = time.monotonic()
        shown.now_and_then(time.monotonic() - heard)
        if session.done or asked:
            return


def standard_input() -> Iterator[bytes]:
    while True:
        if select.select([sys.stdin.fileno()], [], [], TICK)[0]:
            chunk = os.read(sys.stdin.fileno(), 1 << 16)
            if not chunk:
                return
            yield chunk
        else:
            yield b""


def connections(source: str) -> Iterator[bytes]:
    """What clients send, one after the other; a client that leaves may come back."""
    try:
        server = socket.create_server(("127.0.0.1", int(source.removeprefix("tcp:"))))
    except (ValueError, OSError) as error:
        raise ConfigError(f"{source}: cannot listen there ({error})") from None
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
                        yield b"\n"  # a line torn off is none
                        break
                    yield chunk


class Pace:
    """Waits until a row is due at so many times real time."""

    def __init__(self, speed: float) -> None:
        self.speed, self.began, self.first = speed, time.monotonic(), float("nan")

    def wait(self, t: float, meanwhile: Callable[[], None] | None = None, asked: Asked | None = None) -> None:
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


class Shown:
    """The live view: a table that stays in place on a terminal, else a line now and then."""

    def __init__(self, session: Session, quiet: bool) -> None:
        self.session, self.quiet, self.next, self.live = session, quiet, 0.0, None
        if not quiet and sys.stdout.isatty():
            from rich.live import Live

            self.live = Live(auto_refresh=False)
            self.live.start()

    def now_and_then(self, silent: float = 0.0) -> None:
        if not self.quiet and time.monotonic() >= self.next:
            self.update(silent)

    def update(self, silent: float = 0.0) -> None:
        if self.quiet:
            return
        lines = view(self.session, silent)
        if self.live is None:
            self.next = time.monotonic() + 10.0 * TICK
            print("; ".join(f"{label}: {value}" for label, value in lines), flush=True)
            return
        from rich.table import Table

        self.next = time.monotonic() + TICK
        table = Table(show_header=False, box=None)
        for label, value in lines:
            table.add_row(label, value)
        self.live.update(table, refresh=True)

    def last(self) -> None:
        self.update()
        if self.live is not None:
            self.live.stop()


if __name__ == "__main__":
    sys.exit(main())

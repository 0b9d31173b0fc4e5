"""Ways to spoil a file: text, bytes, TOML, YAML, JSON, and lines of a live source. All chance comes from the caller."""

from __future__ import annotations

import gzip
import io
import random
import re
import struct
from collections.abc import Callable, Sequence

import logs
import numpy as np
from logs import frame

NUMBERS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e300", "1e-320", "-0", "0", "1_000", "\uff11\uff12", "0x1f", "1e", "",
    " ", "1,5", "--1", "1e5000", "9" * 400, "9" * 5000, "1.7976931348623157e308", "4.9e-324", "9007199254740993", "NaN",
    "1e9", "-1", "214", "9999.9", "99999999999999999999", "1e-9", "+1", "true", "null", "0.1.2", "\u0661", "1e11",
)  # fmt: skip
WORDS = (
    "", "\0", "a\0b", "x" * 5000, "../../../etc/passwd", "/dev/zero", "/dev/stdin", ".", "..", "~", "\x1b]0;x\x07", "'",
    '"', "\\", "%n%s", "<script>", "\u202e", "\ud7ff", "file:///etc/passwd", "C:\\x", "\r", "inf", "1e309", "{", "[",
)  # fmt: skip
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")

Chance = random.Random
Mutator = Callable[[bytes, Chance], bytes]


def nasty(chance: Chance) -> str:
    """A number, or a word in its place."""
    return chance.choice(NUMBERS if chance.random() < 0.8 else WORDS)


# ------------------------------------------------------------------------------------------------------- bytes
def flip(data: bytes, chance: Chance) -> bytes:
    out = bytearray(data)
    for _ in range(chance.choice((1, 1, 1, 2, 8, 64))):
        k = chance.randrange(len(out))
        out[k] ^= 1 << chance.randrange(8)
    return bytes(out)


def cut(data: bytes, chance: Chance) -> bytes:
    return data[: chance.randrange(len(data))]


def without(data: bytes, chance: Chance) -> bytes:
    at = chance.randrange(len(data))
    return data[:at] + data[at + chance.choice((1, 2, 7, 64, 4096)) :]


def again(data: bytes, chance: Chance) -> bytes:
    at, size = chance.randrange(len(data)), chance.choice((1, 8, 64, 1000))
    return data[: at + size] + data[at : at + size] + data[at + size :]


def garbage(data: bytes, chance: Chance) -> bytes:
    at = chance.randrange(len(data))
    return data[:at] + chance.randbytes(chance.choice((1, 3, 40, 3000))) + data[at:]


def zeros(data: bytes, chance: Chance) -> bytes:
    at, size = chance.randrange(len(data)), chance.choice((1, 4, 64, 5000))
    return data[:at] + bytes(size) + data[at + size :]


BINARY: tuple[Mutator, ...] = (flip, flip, cut, without, again, garbage, zeros)


# -------------------------------------------------------------------------------------------------------- text
def _lines(data: bytes) -> list[bytes]:
    return data.split(b"\n")


def cell(data: bytes, chance: Chance) -> bytes:
    """One or a few numbers become something else."""
    text = data.decode("utf-8", "surrogateescape")
    found = list(_NUMBER.finditer(text))
    for one in sorted(chance.sample(found, min(len(found), chance.choice((1, 1, 1, 3, 20)))), key=lambda m: -m.start()):
        text = text[: one.start()] + nasty(chance) + text[one.end() :]
    return text.encode("utf-8", "surrogateescape")


def column(data: bytes, chance: Chance) -> bytes:
    """One column becomes something else in all rows, or in half of them."""
    lines, share = _lines(data), chance.choice((0.5, 1.0))
    width = lines[len(lines) // 2].count(b",") + 1
    k, value = chance.randrange(width), nasty(chance).encode("utf-8", "surrogateescape")
    for n in range(1, len(lines)):
        cells = lines[n].split(b",")
        if len(cells) == width and chance.random() < share:
            cells[k] = value
            lines[n] = b",".join(cells)
    return b"\n".join(lines)


def lines_moved(data: bytes, chance: Chance) -> bytes:
    lines = _lines(data)
    a, b = sorted(chance.randrange(len(lines)) for _ in range(2))
    how = chance.randrange(5)
    if how == 0:
        lines[a], lines[b] = lines[b], lines[a]
    elif how == 1:
        del lines[a : min(b, a + 50)]
    elif how == 2:
        lines[b:b] = lines[a : a + chance.choice((1, 2, 50))]
    elif how == 3:
        lines[a:b] = lines[a:b][::-1]
    else:
        lines.insert(a, b"" if chance.random() < 0.3 else chance.choice((b"#", b"%", b",", b"\t", b"a" * 5000)))
    return b"\n".join(lines)


def dressed(data: bytes, chance: Chance) -> bytes:
    """Other line ends, marks and codings."""
    how = chance.randrange(9)
    if how == 0:
        return b"\xef\xbb\xbf" + data
    if how == 1:
        return data.replace(b"\n", b"\r\n")
    if how == 2:
        return data.replace(b"\n", b"\r")
    if how == 3:
        return data.decode("utf-8", "replace").encode("utf-16")
    if how == 4:
        return data.replace(b",", b";")
    if how == 5:
        return data.replace(b",", b" , ")
    if how == 6:
        return data.rstrip(b"\n")
    if how == 7:
        return data.upper()
    return data.replace(b".", b",")


def header(data: bytes, chance: Chance) -> bytes:
    lines = _lines(data)
    names = lines[0].split(b",")
    k = chance.randrange(len(names))
    how = chance.randrange(4)
    if how == 0:
        names[k] = chance.choice(WORDS).encode("utf-8", "surrogateescape")
    elif how == 1:
        names[k] = names[chance.randrange(len(names))]
    elif how == 2:
        names.insert(k, b"more")
    else:
        del names[k]
    return b"\n".join([b",".join(names), *lines[1:]])


TEXT: tuple[Mutator, ...] = (cell, cell, cell, lines_moved, lines_moved, dressed, flip, cut, without, again, garbage)
TABLE: tuple[Mutator, ...] = (*TEXT, cell, cell, column, column, header)


# ------------------------------------------------------------------------------------------ TOML, YAML and JSON
def value(data: bytes, chance: Chance) -> bytes:
    """What stands behind a = or a : becomes something else."""
    lines = _lines(data)
    at = [n for n, line in enumerate(lines) if re.search(rb"[=:]", line)]
    for n in chance.sample(at, min(len(at), chance.choice((1, 1, 1, 2)))):
        key, mark, _ = re.split(rb"([=:])", lines[n], maxsplit=1)
        lines[n] = key + mark + b" " + _value(chance).encode("utf-8", "surrogateescape")
    return b"\n".join(lines)


def _value(chance: Chance) -> str:
    how = chance.randrange(8)
    if how == 0:
        return f'"{chance.choice(WORDS)}"'
    if how == 1:
        return "[" + ", ".join(chance.choice(NUMBERS[:12]) for _ in range(chance.choice((0, 1, 3, 3, 100)))) + "]"
    if how == 2:
        deep = chance.choice((10, 100, 3000))
        return "[" * deep + "]" * deep
    if how == 3:
        return "{ a = 1 }" if chance.random() < 0.5 else "{a: 1}"
    if how == 4:
        return chance.choice(
            ("2022-13-45", "2022-10-10", "07:99:00", "true", "null", "~", "!!python/object:os.system", "&a 1")
        )
    return nasty(chance)


def key(data: bytes, chance: Chance) -> bytes:
    lines = _lines(data)
    n = chance.randrange(len(lines))
    how = chance.randrange(5)
    if how == 0:
        lines.insert(n, b"[" + b".".join([b"a"] * chance.choice((1, 3, 3000))) + b"]")
    elif how == 1:
        lines.insert(n, b"more = 1")
    elif how == 2:
        lines.insert(n, b".".join([b"a"] * chance.choice((2, 3000))) + b" = 1")
    elif how == 3:
        lines[n] = re.sub(rb"\w+", b"x", lines[n], count=1)
    else:
        lines.insert(n, lines[chance.randrange(len(lines))])
    return b"\n".join(lines)


def bomb(data: bytes, chance: Chance) -> bytes:
    """Aliases of aliases of aliases."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 8)}]" for k in range(1, 12)]
    return "\n".join(lines).encode() + b"\n" + data + chance.choice((b"\nantlever: *a11\n", b"\narw: *a11\n", b""))


WRITTEN: tuple[Mutator, ...] = (value, value, value, key, key, lines_moved, flip, cut, garbage, dressed)
YAML: tuple[Mutator, ...] = (*WRITTEN, bomb)


# ------------------------------------------------------------------------------- logs whose checksums are mended
def nmea_field(data: bytes, chance: Chance) -> bytes:
    """Fields of sentences become something else, with the checksum of what they are then."""
    lines = _lines(data)
    for _ in range(chance.choice((1, 1, 5, 40))):
        n = chance.randrange(len(lines))
        body = lines[n].decode("utf-8", "replace").strip().lstrip("$").split("*")[0].split(",")
        body[chance.randrange(len(body))] = nasty(chance).replace("\0", "")
        lines[n] = logs.sentence(",".join(body)).rstrip("\n").encode("utf-8", "replace")
    return b"\n".join(lines)


def ubx_field(data: bytes, chance: Chance) -> bytes:
    """Bytes of payloads become something else, with the checksum of what they are then."""
    parts = data.split(b"\xb5\x62")
    for _ in range(chance.choice((1, 1, 5, 40))):
        k = chance.randrange(1, len(parts))
        payload = bytearray(parts[k][4:-2])
        if len(parts[k]) < 7 or len(parts[k]) != 6 + struct.unpack("<H", parts[k][2:4])[0]:
            continue
        at, size = chance.randrange(len(payload)), chance.choice((1, 2, 4))
        payload[at : at + size] = chance.choice((bytes(size), b"\xff" * size, b"\x7f" * size, chance.randbytes(size)))
        parts[k] = frame(parts[k][0], parts[k][1], bytes(payload))[2:]
    return b"\xb5\x62".join(parts)


NMEA: tuple[Mutator, ...] = (nmea_field, nmea_field, nmea_field, *TEXT)
UBX: tuple[Mutator, ...] = (ubx_field, ubx_field, ubx_field, *BINARY)


def packed(data: bytes, chance: Chance) -> bytes:
    """Compressed, and spoilt, or not."""
    out = gzip.compress(data, 1, mtime=0)
    return chance.choice(BINARY)(out, chance) if chance.random() < 0.8 else out


# ------------------------------------------------------------------------------------- files of fixed columns
def results(data: bytes, chance: Chance) -> bytes:
    """Arrays and JSON in an archive: its bytes, or what is in it, packed again as it should be."""
    if chance.random() < 0.2:
        return chance.choice(BINARY)(data, chance)
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    if chance.random() < 0.5:
        text = arrays["text"].tobytes()
        text = number(text, chance) if chance.random() < 0.5 else chance.choice(BINARY)(text, chance)
        arrays["text"] = np.frombuffer(text, dtype=np.uint8)
    else:
        name = chance.choice([name for name in arrays if name != "text"])
        arrays[name] = _array(arrays[name], chance)
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def number(data: bytes, chance: Chance) -> bytes:
    """Another number, or a word, in the place of one."""
    text = data.decode()
    found = chance.choice(list(_NUMBER.finditer(text)))
    return (text[: found.start()] + nasty(chance) + text[found.end() :]).encode("utf-8", "surrogatepass")


def _array(x: np.ndarray, chance: Chance) -> np.ndarray:
    """An array of other length, shape or kind, or with other values in it."""
    how = chance.randrange(6)
    if how == 0:
        return x[: len(x) // 2] if x.ndim else np.zeros(3)
    if how == 1:
        return x.reshape(-1)
    if how == 2:
        return x.astype(chance.choice(("U8", "f2", "c16", "i8")))
    if how == 3:
        return np.repeat(np.atleast_1d(x), 2, axis=0)
    out = np.array(x, dtype=float) if x.dtype.kind in "biuf" else np.zeros(x.shape)
    where = slice(None) if how == 4 or not out.size else chance.randrange(out.size)
    out.reshape(-1)[where] = chance.choice((np.nan, np.inf, 1e300, -1e300, 1e9, -1.0, 0.0, 5e-324))
    return out


def field(data: bytes, chance: Chance) -> bytes:
    """Numbers become something else that is as wide."""
    text = data.decode("latin-1")
    found = list(_NUMBER.finditer(text))
    for one in chance.sample(found, min(len(found), chance.choice((1, 1, 1, 3, 20)))):
        wide = one.end() - one.start()
        other = chance.choice(("nan", "inf", "-inf", "1e300", "-1", "0", "9" * wide, "-" * wide, "1_0", "1D99", ""))
        text = text[: one.start()] + other.rjust(wide)[:wide] + text[one.end() :]
    return text.encode("latin-1")


COLUMNS: tuple[Mutator, ...] = (field, field, field, field, *TEXT)


# ---------------------------------------------------------------------------------------------- a live source
def stream(lines: Sequence[str], chance: Chance) -> list[str]:
    """A few lines spoilt, doubled, late or absurd."""
    out = list(lines)
    for _ in range(chance.choice((1, 3, 10))):
        n = chance.randrange(1, len(out) - 1)
        cells = out[n].split(",")
        how = chance.randrange(7)
        if how == 0:
            cells[chance.randrange(1, len(cells))] = nasty(chance).replace("\n", "")
            out[n] = ",".join(cells)
        elif how == 1:
            out[n : n + 1] = [out[n]] * 2
        elif how == 2:
            out.insert(min(n + chance.choice((1, 5, 200)), len(out) - 1), out.pop(n))
        elif how == 3:
            wild = chance.choice(("1e6", "1e300", "-1e300", "400"))
            out.insert(n, ",".join([*cells[:2], *([wild] * (len(cells) - 2))]))
        elif how == 4:
            out.insert(n, chance.choice(("", "#", "X,1", "I", "G,,,,,,,", "\0", "a" * 5000, "O,nan,1", "E,")))
        elif how == 5:
            del out[n : n + chance.choice((1, 3, 100))]
        else:
            cells[1] = chance.choice(("1e300", "-1e300", "-5", "1e9", "nan"))
            out.insert(n, ",".join(cells))
    return out

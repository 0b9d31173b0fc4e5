"""A sentence for the user with a stable key beside it, which does not change when the wording does."""

from __future__ import annotations


class Note(str):
    """A sentence and its stable key, which says where it comes from and what it is about, such as "noise.outliers".

    It is a string: code that only shows it needs no key; scripts and tests read `key`.
    """

    __slots__ = ("key",)
    key: str

    def __new__(cls, key: str, sentence: str) -> Note:
        """Make a note of a sentence and its key."""
        note = super().__new__(cls, sentence)
        note.key = key
        return note

    def __reduce__(self) -> tuple[type[Note], tuple[str, str]]:  # for copies and pickles
        return Note, (self.key, str(self))


class Notes(list[str]):
    """Notes in the order in which they were made."""

    def add(self, key: str, sentence: str) -> None:
        """Add a note under a key."""
        self.append(Note(key, sentence))


def get_key(sentence: str) -> str:
    """The key of a sentence, "" if it has none."""
    return sentence.key if isinstance(sentence, Note) else ""


def format_count(number: int, one: str, several: str = "") -> str:
    """A number with its noun: "1 row", "2 rows"; `several` is the plural where an s does not make it."""
    return f"{number} {one if number == 1 else several or one + 's'}"

"""A sentence that users meet, with a key beside it that stays the same whatever its words are."""

from __future__ import annotations


class Note(str):
    """A sentence and its stable key: where it comes from, and what it is about, such as "noise.outliers".

    It is a string, so code that only shows it needs no keys; scripts and tests read `key`.
    """

    __slots__ = ("key",)
    key: str

    def __new__(cls, key: str, sentence: str) -> Note:
        """The sentence with its key."""
        note = super().__new__(cls, sentence)
        note.key = key
        return note

    def __reduce__(self) -> tuple[type[Note], tuple[str, str]]:  # for copies and pickles
        return Note, (self.key, str(self))


def key_of(sentence: str) -> str:
    """The key of a sentence, "" of one without."""
    return sentence.key if isinstance(sentence, Note) else ""

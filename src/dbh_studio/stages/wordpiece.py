"""A prompt as the numbers BERT reads: words cut into pieces of a vocabulary.

Written here because the `tokenizers` package brings ten others with it; `tests/parity` holds it to that package.
"""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from dbh_studio.core.arrays import Int64
from dbh_studio.errors import FileMissingError, MalformedFileError, SettingError

_START, _END, _UNKNOWN, _PADDING = "[CLS]", "[SEP]", "[UNK]", "[PAD]"
_LONGEST_WORD = 100
# Control, format, private-use and surrogate characters are left out; unassigned ones stay.
_INVISIBLE = ("Cc", "Cf", "Co", "Cs")
# Chinese characters are words of their own; the blocks BERT counts among them.
_CJK = (
    (0x4E00, 0x9FFF),
    (0x3400, 0x4DBF),
    (0x20000, 0x2A6DF),
    (0x2A700, 0x2B73F),
    (0x2B740, 0x2B81F),
    (0x2B820, 0x2CEAF),
    (0xF900, 0xFAFF),
    (0x2F800, 0x2FA1F),
)


class WordPiece:
    """The tokenizer of `bert-base-uncased`.

    Args:
        vocabulary: Piece → number.

    Raises:
        ValueError: A piece that every prompt needs is missing.
    """

    def __init__(self, vocabulary: Mapping[str, int]) -> None:
        self._numbers = dict(vocabulary)
        self._pieces = {number: piece for piece, number in self._numbers.items()}
        missing = [piece for piece in (_START, _END, _UNKNOWN, ".") if piece not in self._numbers]
        if missing:
            raise ValueError(f"the vocabulary lacks {', '.join(missing)}")

    @property
    def separators(self) -> tuple[int, ...]:
        """Numbers that end a phrase: those of the start, the end, the full stop and the question mark."""
        return tuple(self._numbers[piece] for piece in (_START, _END, ".", "?") if piece in self._numbers)

    @property
    def padding(self) -> int:
        """The number that fills a prompt up."""
        return self._numbers.get(_PADDING, 0)

    def encode(self, text: str) -> Int64:
        """(L,) numbers, with the start and the end."""
        words = [piece for word in _words(text) for piece in self._cut(word)]
        return np.array([self._numbers[piece] for piece in (_START, *words, _END)], np.int64)

    def text(self, numbers: Iterable[int]) -> str:
        """What pieces say, without the start, the end and the padding."""
        result = ""
        for number in numbers:
            piece = self._pieces.get(int(number), _UNKNOWN)
            if piece in (_START, _END, _PADDING):
                continue
            if piece.startswith("##"):
                result += piece[2:]
            else:
                result += f" {piece}" if result else piece
        return result

    def _cut(self, word: str) -> list[str]:
        """The longest pieces from the left."""
        if len(word) > _LONGEST_WORD:
            return [_UNKNOWN]
        pieces: list[str] = []
        start = 0
        while start < len(word):
            prefix = "##" if start else ""
            ends = range(len(word), start, -1)
            end = next((end for end in ends if prefix + word[start:end] in self._numbers), None)
            if end is None:
                return [_UNKNOWN]
            pieces.append(prefix + word[start:end])
            start = end
        return pieces


def read_vocabulary(path: Path) -> WordPiece:
    """Read ``vocab.txt`` (a piece per line) or ``tokenizer.json``.

    Raises:
        FileMissingError: There is no such file.
        MalformedFileError: It is no BERT vocabulary.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".json":
            model = json.loads(text)["model"]
            if model.get("type", "WordPiece") != "WordPiece":
                raise ValueError(f"its tokens are made by {model['type']}")
            return WordPiece({str(piece): int(number) for piece, number in model["vocab"].items()})
        return WordPiece({piece: number for number, piece in enumerate(text.split("\n")) if piece})
    except FileNotFoundError:
        raise FileMissingError(path, "There is no such file.", "Fetch the vocabulary again.") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise MalformedFileError(path, f"It is no BERT vocabulary ({error}).", "Fetch it again.") from error


def phrases_of(prompt: str) -> tuple[str, ...]:
    """The phrases of a prompt such as ``"Tree trunk. Stump"``: lower case, each ending with its full stop.

    Raises:
        SettingError: There is none.
    """
    phrases = tuple(f"{part}." for part in (part.strip().lower() for part in prompt.split(".")) if part)
    if not phrases:
        raise SettingError("The prompt is empty.", 'Say what to look for, such as "tree trunk".')
    return phrases


def phrase_masks(tokens: Int64, separators: Sequence[int]) -> tuple[Int64, Int64]:
    """Which tokens may look at which, so that phrases do not mix: what graphs of the authors' own code ask for.

    Args:
        tokens: (L,).
        separators: Tokens that end a phrase.

    Returns:
        (L, L) 1 where both are of one phrase, or the same token; (L,) place within the phrase.
    """
    index = np.arange(len(tokens))
    ends = np.isin(tokens, separators)
    # The first separator at or after each token, the last one strictly before it.
    after = np.minimum.accumulate(np.where(ends, index, len(tokens))[::-1])[::-1]
    before = np.concatenate([[-1], np.maximum.accumulate(np.where(ends, index, -1))[:-1]])
    # The start and the end of the whole belong to no phrase.
    in_phrase = (after > 0) & (after < len(tokens) - 1)
    together = (after[:, None] == after[None, :]) & in_phrase[:, None] | np.eye(len(tokens), dtype=bool)
    return together.astype(np.int64), np.where(in_phrase, index - before - 1, 0).astype(np.int64)


def _words(text: str) -> list[str]:
    """Lower case without accents; every punctuation mark and every Chinese character by itself."""
    spaced = []
    for char in text:
        if char in "\t\n\r":
            spaced.append(" ")
        elif ord(char) in (0, 0xFFFD) or unicodedata.category(char) in _INVISIBLE:
            continue
        elif char.isspace():
            spaced.append(" ")
        elif any(first <= ord(char) <= last for first, last in _CJK):
            spaced.append(f" {char} ")
        else:
            spaced.append(char)
    decomposed = unicodedata.normalize("NFD", "".join(spaced))
    plain = "".join(char for char in decomposed if unicodedata.category(char) != "Mn").lower()
    parted = (f" {char} " if _is_punctuation(char) else char for char in plain)
    return "".join(parted).split()


def _is_punctuation(char: str) -> bool:
    return (char.isascii() and char.isprintable() and not char.isalnum() and char != " ") or (
        unicodedata.category(char)[0] == "P"
    )

"""Wording of counts, and quotation of input: never without a limit."""

from reprlib import Repr

_LONGEST = 60
_REPR = Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = _LONGEST
_REPR.maxlevel, _REPR.maxlist, _REPR.maxdict, _REPR.maxtuple, _REPR.maxset = 2, 4, 4, 4, 4


def counted(number: int, noun: str) -> str:
    """A number of things in words: "1 frame", "2 frames"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def encodable(text: str) -> str:
    """A text with a mark for what is not UTF-8 in it, as names of files may have."""
    return text.encode(errors="surrogateescape").decode(errors="replace")


def shown(value: object) -> str:
    """``repr`` of what a user gave, of a file or of the network, shortened to a part of a line."""
    return shortened(_REPR.repr(value), 2 * _LONGEST)


def shortened(text: str, longest: int = _LONGEST) -> str:
    """A text with its middle left out where it is longer."""
    if len(text) <= longest:
        return text
    head = (longest - 3) // 2
    return f"{text[:head]}...{text[len(text) - (longest - 3 - head) :]}"

"""Text files as users write them: UTF-8, with or without a byte order mark, or UTF-16 with one."""

import codecs

_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def decoded(data: bytes, errors: str = "strict") -> str:
    """The text of a file.   errors: as of ``bytes.decode``.  Raises UnicodeDecodeError."""
    return data.decode("utf-16" if data.startswith(_UTF_16) else "utf-8-sig", errors)

"""How numbers of things are said."""


def counted(number: int, noun: str) -> str:
    """A number of things in words: "1 frame", "2 frames"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"

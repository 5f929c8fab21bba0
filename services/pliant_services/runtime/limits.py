"""Limits of the shell, checked before services start: Zenoh's threads would hang without a
message.
"""

import resource

from pliant.errors import PliantError

_FILES, _WANTED_FILES = 128, 1024
_ADDRESSES = 4 << 30
"""Bytes of address space that a service may reserve, whatever it uses of them."""


def check_limits() -> None:
    """Take as many open files as the system grants.  Raises PliantError if limits are too low
    for a service."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    if soft != unlimited and soft < _WANTED_FILES:
        soft = _WANTED_FILES if hard == unlimited else min(hard, _WANTED_FILES)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if soft != unlimited and soft < _FILES:
        raise PliantError(f"only {soft} open files are allowed: run ulimit -n {_WANTED_FILES}")
    addresses, _ = resource.getrlimit(resource.RLIMIT_AS)
    if addresses != unlimited and addresses < _ADDRESSES:
        raise PliantError(
            f"only {addresses >> 20} MiB of address space are allowed, but a service needs "
            f"{_ADDRESSES >> 20}: run ulimit -v unlimited"
        )

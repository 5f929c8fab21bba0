"""The command line: one small file per command, heavy modules imported inside the command."""

import errno
import importlib
import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import TYPE_CHECKING

from pliant.errors import PliantError, SourceLostError
from pliant.exit_codes import DONE, FAILED, INCOMPLETE, INTERRUPTED, USAGE
from pliant.wording import shortened
from pliant_services.runtime.interruptions import deliver_swallowed_interruptions

if TYPE_CHECKING:
    import typer

_INTERRUPTIONS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_LACKING = {
    errno.EMFILE: "too many open files for this shell's limit: run ulimit -n 1024",
    errno.ENFILE: "too many open files on this machine: close other programs",
    errno.ENOMEM: "not enough memory: close other programs, or raise ulimit -v",
}
"""Advice by the error of the system."""


class UsageError(Exception):
    """A command line that cannot be understood; no text where all has been said."""

    def __init__(self, text: str, code: int = USAGE) -> None:
        super().__init__(text)
        self.code = code


def main(application: "typer.Typer | None" = None) -> None:
    """Run the command ``pliant``, or another with the same exit codes."""
    _open_standard_streams()
    # A container stops by SIGTERM and a terminal that closes sends SIGHUP: both are a Ctrl-C.
    for kind in _INTERRUPTIONS:
        if signal.getsignal(kind) == signal.SIG_DFL:  # not under nohup
            signal.signal(kind, signal.default_int_handler)
    deliver_swallowed_interruptions()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="surrogateescape")  # names of files are bytes
    try:
        run_and_exit(application)
    except KeyboardInterrupt:  # one more, just before it was ignored
        os._exit(INTERRUPTED)
    except BaseException as error:
        others = [each for each in threading.enumerate() if each is not threading.main_thread()]
        if all(each.daemon for each in others):
            raise
        _leave_at_once(error)  # the interpreter would wait for threads that a failure left behind
    finally:
        _take_no_more()


def _open_standard_streams() -> None:
    """Connect those that are closed (``>&-``) to /dev/null.

    Else Python has none of them, and the next file or socket gets the number of stderr: what any
    library reports goes there.
    """
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free: this one
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


def _leave_at_once(error: BaseException) -> None:
    """End with the exit code of an error, or with its traceback."""
    code = FAILED
    if isinstance(error, SystemExit) and isinstance(error.code, int | None):
        code = error.code or DONE
    elif not isinstance(error, SystemExit):
        traceback.print_exception(error)
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def run_and_exit(application: "typer.Typer | None" = None) -> None:
    """Run the command line.  Known errors are one line on stderr and an exit code."""
    code = _run(application)
    try:
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing more to flush
        if error.errno != errno.EPIPE and not code:  # `| head` has seen enough
            code = _say(f"cannot write the output: {error.strerror}; free some space")
    if code >= INTERRUPTED:
        # All is closed, but a Zenoh session that was just being opened or closed leaves threads
        # behind for which the interpreter would wait without end.
        os._exit(code)
    sys.exit(code)


def _run(application: "typer.Typer | None") -> int:
    try:
        os.getcwd()
    except OSError as error:
        return _say(f"the current folder is not accessible ({error.strerror}): cd to another one")
    try:
        with nullcontext() if application else _server_ahead(sys.argv[1:]):
            commands = importlib.import_module("pliant_services.cli.commands")
            code = commands.run_command(application or commands.app)
    except PliantError as error:
        return _say(str(error), INCOMPLETE if isinstance(error, SourceLostError) else FAILED)
    except UsageError as error:
        return _say(str(error), error.code) if str(error) else error.code
    except KeyboardInterrupt:
        _take_no_more()
        code = INTERRUPTED
    except SystemExit as end:  # of a signal
        return end.code if isinstance(end.code, int) else FAILED
    except MemoryError:
        return _say(_LACKING[errno.ENOMEM])
    except RuntimeError as error:
        if str(error) != "can't start new thread":
            raise
        return _say(f"{error}: close other programs, or raise ulimit -u and ulimit -v")
    except OSError as error:
        if error.errno in _LACKING:
            return _say(_LACKING[error.errno])
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        where = f"{error.filename}" if error.filename else "the output"
        return _say(f"cannot write {where}: {error.strerror}; free some space")
    if code == INTERRUPTED:
        return _say("interrupted", INTERRUPTED)
    return code if isinstance(code, int) else 0


def _server_ahead(arguments: Sequence[str]) -> AbstractContextManager[None]:
    """The fork server of a run, which imports while this process reads the command line.

    It imports what the other profile needs when it is to be forked.
    """
    if arguments[:1] != ["run"] or len(arguments) < 2 or "--help" in arguments:
        return nullcontext()
    from pliant_services.profiles import PROFILES
    from pliant_services.runtime.fork_server import started_ahead

    return started_ahead(PROFILES["deformable" if "deformable" in arguments else "rigid"])


def _take_no_more() -> None:
    """Ignore further interruptions: they must change neither the last line nor the exit code."""
    for kind in _INTERRUPTIONS:
        signal.signal(kind, signal.SIG_IGN)


_LONGEST_LINE = 2000
"""Whatever an error quotes."""


def _say(line: str, code: int = FAILED) -> int:
    with suppress(OSError):
        print(f"pliant: {shortened(line, _LONGEST_LINE)}", file=sys.stderr)
    return code

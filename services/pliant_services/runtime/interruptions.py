"""Interruptions that nothing swallows."""

import signal
import sys
import threading
from typing import Any

_AGAIN_S = 0.01  # long enough to be out of the destructor, short enough not to delay the end
_RAISED_BY = {KeyboardInterrupt: signal.SIGINT, SystemExit: signal.SIGTERM}


def deliver_swallowed_interruptions() -> None:
    """Deliver an interruption again where Python could not raise it.

    Python runs the handler of a signal between any two instructions of the main thread.  In a
    destructor or in the callback of a weak reference, what the handler raises goes nowhere: Python
    prints it and continues, and a command that should end would run on.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    lost: list[signal.Signals] = []
    usual_hook = sys.unraisablehook

    def on_unraisable(unraisable: Any) -> None:
        kind = _RAISED_BY.get(unraisable.exc_type)
        if kind is None:
            usual_hook(unraisable)
            return
        lost.append(kind)
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)

    def on_alarm(*_: object) -> None:
        while lost:
            signal.raise_signal(lost.pop())

    sys.unraisablehook = on_unraisable
    signal.signal(signal.SIGALRM, on_alarm)

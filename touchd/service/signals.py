"""SIGTERM and SIGINT stop a daemon or a verb, SIGHUP reloads a configuration, SIGUSR1 saves a pre-roll."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # `hold` comes before all that takes its time to import
    from touchd.service.loop import Service
    from touchd.service.preroll import PreRoll

_HELD = (signal.SIGHUP, signal.SIGUSR1)
_AGAIN_S = 0.02
"""While modules are imported, a signal that ends a verb waits, and looks again after so long."""


def stops() -> list[signal.Signals]:
    """Return what stops a program in order; SIGHUP, of a terminal that closes, unless it is ignored, as under nohup."""
    hangup = [] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [signal.SIGHUP]
    return [signal.SIGINT, signal.SIGTERM, *hangup]


def hold() -> None:
    """Let SIGHUP and SIGUSR1 wait until `deliver`: a daemon that starts would end of them.

    Those of the interpreter's own start, some 20 ms, still end it.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, _HELD)


def deliver() -> None:
    """Let SIGHUP and SIGUSR1 come, those that wait first; call it once they have handlers."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _HELD)


@contextmanager
def stopping() -> Iterator[threading.Event]:
    """Yield an event that SIGINT, SIGTERM and SIGHUP set, instead of what else they do; see `stops`."""
    stop = threading.Event()

    def handle(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    with ExitStack() as stack:
        for number in stops():
            stack.callback(signal.signal, number, signal.signal(number, handle))
        yield stop


def _imports(frame: FrameType | None) -> bool:
    """Return whether a module is being imported."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


class Terminated(BaseException):
    """SIGTERM or SIGHUP has come to a verb without a handler of its own."""


@contextmanager
def unwound() -> Iterator[None]:
    """Let SIGTERM and SIGHUP unwind what runs within this context, so that no half of a file stays, and then end it."""
    came: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a terminal that goes sends it more than once
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a second one ends the process at once
        came.append(number)
        signal.signal(signal.SIGALRM, leave)
        leave(number, frame)

    def leave(_number: int, frame: FrameType | None) -> None:
        if _imports(frame):  # a module that does without what it imports would go on without the error
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
            return
        raise Terminated

    in_main_thread = threading.current_thread() is threading.main_thread()  # others may set no handler
    handled = [number for number in (signal.SIGTERM, signal.SIGHUP)
               if in_main_thread and signal.getsignal(number) is signal.SIG_DFL]  # fmt: skip
    for number in handled:
        signal.signal(number, handle)
    try:
        yield
    except BaseException:  # a library may have made another error of it: the process ends by the signal
        if not came:
            raise
    finally:
        for number in handled:
            signal.signal(number, signal.SIG_DFL)
        if came:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.raise_signal(came[0])


def stop_on_signals(service: Service) -> None:
    """Stop the service in order on SIGTERM or SIGINT; a second one ends the process at once."""

    def handle(number: int, _frame: FrameType | None) -> None:
        service.stop()
        signal.signal(number, signal.SIG_DFL)

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)


def reload_on_hangup(service: Service) -> None:
    """Reload the configuration on SIGHUP; a daemon in a terminal stops in order with it, one under nohup ignores it."""
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        return
    obey = service.stop if sys.stdin is not None and sys.stdin.isatty() else service.reload
    signal.signal(signal.SIGHUP, lambda _number, _frame: obey())


def save_on_signal(preroll: PreRoll) -> None:
    """Save the pre-roll on SIGUSR1."""
    signal.signal(signal.SIGUSR1, lambda _number, _frame: preroll.request("sigusr1"))

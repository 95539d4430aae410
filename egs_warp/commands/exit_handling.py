"""How a program ends: whatever stops it, it says one line, leaves no half-written file and has a status of its own.

0 done, 1 memory or disk gave out, 2 bad input, 3 written, but fallen or stopped (``animate``), 130 ended by
Ctrl-C, 143 asked to end (SIGTERM).
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn, TextIO

from egs_warp.commands.flags import flag_of
from egs_warp.errors import UserError

_GAVE_OUT = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""What a machine runs out of: no input is at fault."""
_REFUSED = (errno.EROFS, errno.EACCES, errno.EPERM)
"""Places that are not this user's to write or read. Errors that are in neither are ours, and keep their traceback."""

_AGAIN = 0.05
"""Seconds after which a signal that was lost comes again."""


class HandledExit(SystemExit):
    """The program has told why it ends."""


class _TerminatedError(BaseException):
    """SIGTERM."""


@contextmanager
def one_line_errors(program: str) -> Iterator[None]:
    """Whatever stops the ``program`` within prints one line and ends it with a status (``docs/reliability.md``).

    Bad input names flags and ends it with 2, or with 1 where a machine that gave out is behind it. Ctrl-C and SIGTERM
    unwind once: a second Ctrl-C ends it at once. A pipe that is closed at its other end only silences the program.
    """

    def end(status: int, line: str) -> NoReturn:
        with contextlib.suppress(OSError):
            print(f"{program}: {line}", file=sys.stderr)
        raise HandledExit(status) from None

    with _signals() as came, _deaf_streams():
        try:
            with _unwinding(came):
                yield
                # What is still buffered may not find room either.
                sys.stdout.flush()
        except UserError as error:
            end(1 if _gave_out(error.__cause__) else 2, error.format_message(flag_of))
        except KeyboardInterrupt as error:
            end(130, _noted("stopped; finished files are whole, unfinished ones are gone", error))
        except _TerminatedError as error:
            end(143, _noted("asked to end; finished files are whole, unfinished ones are gone", error))
        except MemoryError:
            end(1, "not enough memory; give a smaller capture, picture or number of Gaussians")
        except OSError as error:
            if error.errno not in (*_GAVE_OUT, *_REFUSED, errno.ENAMETOOLONG):
                raise
            if error.errno == errno.ENAMETOOLONG:
                # Python's own look whether a file is there raises it.
                end(2, f"{str(error.filename)[:60]}...: no such file or folder, the name is too long; check the path")
            place = f"{error.filename}: " if error.filename else ""
            end(1 if _gave_out(error) else 2, f"{place}{error.strerror}; free some space, or choose another place")


def _gave_out(cause: BaseException | None) -> bool:
    """Whether an error, or the one behind it, is that the machine has no more of something."""
    return isinstance(cause, MemoryError) or (isinstance(cause, OSError) and cause.errno in _GAVE_OUT)


def _noted(line: str, error: BaseException) -> str:
    """The ``line`` with what was noted on the ``error`` on its way."""
    return "; ".join([line, *getattr(error, "__notes__", [])])


@contextmanager
def _unwinding(came: list[type[BaseException]]) -> Iterator[None]:
    """What a signal has raised goes on as that: of what is raised while it is imported, a library in C makes an error
    of its own ("initialization failed").
    """
    try:
        yield
    except (ImportError, SystemError) as error:
        # Others keep their own line: what fails after a Ctrl-C that ended a server, say.
        if came:
            raise came[0] from error
        raise


@contextmanager
def _signals() -> Iterator[list[type[BaseException]]]:
    """Ctrl-C and SIGTERM raise within, once; yields what they have raised."""
    came: list[type[BaseException]] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return

    def stop(number: int, _: object) -> None:
        if came:
            # What is left over, the next run sweeps.
            os._exit(128 + number)
        came.append(KeyboardInterrupt if number == signal.SIGINT else _TerminatedError)
        raise came[0]

    def unraisable(lost: Any) -> None:
        # Raised inside a destructor or a callback, where Python drops it: it is raised again from a better place.
        if lost.exc_type in (KeyboardInterrupt, _TerminatedError):
            came.clear()
            number = signal.SIGINT if lost.exc_type is KeyboardInterrupt else signal.SIGTERM
            threading.Timer(_AGAIN, os.kill, (os.getpid(), number)).start()
        else:
            before_hook(lost)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    before_hook, sys.unraisablehook = sys.unraisablehook, unraisable
    try:
        yield came
    finally:
        sys.unraisablehook = before_hook
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _deaf_streams() -> Iterator[None]:
    """Output within goes on in silence where nobody reads it any more, or ever did; what cannot be told on stderr stops
    nothing.
    """
    _open_standard_files()
    before = sys.stdout, sys.stderr
    # Python has none where the shell has closed it.
    with open(os.devnull, "w") as nowhere:
        sys.stdout = stdout = _Stream(before[0] or nowhere, BrokenPipeError)
        sys.stderr = _Stream(before[1] or nowhere, OSError)
        try:
            yield
        finally:
            stdout.settle()
            sys.stdout, sys.stderr = before


def _open_standard_files() -> None:
    """Those that the shell has closed lead nowhere: the next file that is opened would get their number, and with it
    whatever libraries print.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # The lowest that is free: this one.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)


class _Stream:
    """A text stream whose reader may go away, or know fewer letters."""

    def __init__(self, stream: TextIO, lost: type[OSError]) -> None:
        """``lost``: errors at which it falls silent."""
        self._stream, self._lost = stream, lost

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """As that of the stream."""
        try:
            return self._stream.write(text)
        except UnicodeEncodeError as error:
            # The name of a folder, say, at the end of hours of work.
            return self._stream.write(text.encode(error.encoding, "backslashreplace").decode(error.encoding))
        except self._lost:
            self._silence()
            return len(text)

    def flush(self) -> None:
        """As that of the stream."""
        try:
            self._stream.flush()
        except self._lost:
            self._silence()

    def settle(self) -> None:
        """Flush; what cannot be written is not tried again when Python ends."""
        try:
            self._stream.flush()
        except OSError:
            self._silence()

    def _silence(self) -> None:
        # What is still buffered goes nowhere, now and when Python ends.
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)

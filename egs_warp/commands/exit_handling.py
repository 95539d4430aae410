"""Exit handling: every error or signal prints one line, leaves no half-written file and sets the exit status.

Exit statuses: 0 done, 1 out of memory or disk space, 2 invalid input, 3 files written but target missed, body fallen or
simulation stopped (``animate``, ``resume``, ``from-photos``), 130 Ctrl-C, 143 SIGTERM.
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

_EXHAUSTED = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""Error numbers that indicate exhausted resources or failing hardware, not invalid input."""
_NOT_PERMITTED = (errno.EROFS, errno.EACCES, errno.EPERM)
"""Error numbers of paths without permission to read or write. Other errors are bugs and keep their traceback."""

_RESEND_DELAY = 0.05
"""Delay after which a signal whose exception was dropped is sent again, s."""


class HandledExit(SystemExit):
    """Exception that ends the program after the reason has been printed."""


class _TerminatedError(BaseException):
    """Exception that is raised on SIGTERM."""


@contextmanager
def one_line_errors(program: str) -> Iterator[None]:
    """Context manager that turns errors and signals into one line on stderr and an exit status.

    A ``UserError`` gives status 2, or 1 if its cause is exhausted memory or disk space; the message names flags. The
    first Ctrl-C or SIGTERM unwinds the stack, a second one ends the process at once. A closed pipe only silences the
    output. See ``docs/reliability.md``.

    Args:
        program: name at the beginning of the line.

    Raises:
        HandledExit: after the line has been printed.
    """

    def end(status: int, line: str) -> NoReturn:
        with contextlib.suppress(OSError):
            print(f"{program}: {line}", file=sys.stderr)
        raise HandledExit(status) from None

    with _signals() as raised, _tolerant_streams():
        try:
            with _unwinding(raised):
                yield
                # Flush here: writing the buffered output may fail, too.
                sys.stdout.flush()
        except UserError as error:
            end(1 if _is_exhausted(error.__cause__) else 2, error.format_message(flag_of))
        except KeyboardInterrupt as error:
            end(130, _noted("stopped; finished files are complete, unfinished ones are removed", error))
        except _TerminatedError as error:
            end(143, _noted("terminated by SIGTERM; finished files are complete, unfinished ones are removed", error))
        except MemoryError:
            end(1, "not enough memory; give a smaller capture, picture or number of Gaussians")
        except OSError as error:
            if error.errno not in (*_EXHAUSTED, *_NOT_PERMITTED, errno.ENAMETOOLONG):
                raise
            if error.errno == errno.ENAMETOOLONG:
                # Path.exists raises this error instead of returning False.
                end(2, f"{str(error.filename)[:60]}...: no such file or folder, the name is too long; check the path")
            path = f"{error.filename}: " if error.filename else ""
            end(1 if _is_exhausted(error) else 2, f"{path}{error.strerror}; free some space, or choose another folder")


def _is_exhausted(cause: BaseException | None) -> bool:
    """Return True if ``cause`` indicates that memory, disk space or file handles are exhausted."""
    return isinstance(cause, MemoryError) or (isinstance(cause, OSError) and cause.errno in _EXHAUSTED)


def _noted(line: str, error: BaseException) -> str:
    """Return ``line`` followed by the notes of ``error``."""
    return "; ".join([line, *getattr(error, "__notes__", [])])


@contextmanager
def _unwinding(raised: list[type[BaseException]]) -> Iterator[None]:
    """Raise the exception of a signal again if a C extension has replaced it.

    An extension whose import is interrupted raises its own error ("initialization failed").
    """
    try:
        yield
    except (ImportError, SystemError) as error:
        # Replace only these errors. Other errors after a Ctrl-C, such as one that has ended a server, are still
        # reported.
        if raised:
            raise raised[0] from error
        raise


@contextmanager
def _signals() -> Iterator[list[type[BaseException]]]:
    """Raise an exception on the first Ctrl-C or SIGTERM; yield the list of the raised exceptions' types."""
    raised: list[type[BaseException]] = []
    if threading.current_thread() is not threading.main_thread():
        yield raised
        return

    def stop(number: int, _: object) -> None:
        if raised:
            # Temporary files need no removal here: the next run removes them.
            os._exit(128 + number)
        raised.append(KeyboardInterrupt if number == signal.SIGINT else _TerminatedError)
        raise raised[0]

    def unraisable(unraised: Any) -> None:
        # Python drops an exception that is raised in a destructor or callback: send the signal again.
        if unraised.exc_type in (KeyboardInterrupt, _TerminatedError):
            raised.clear()
            number = signal.SIGINT if unraised.exc_type is KeyboardInterrupt else signal.SIGTERM
            threading.Timer(_RESEND_DELAY, os.kill, (os.getpid(), number)).start()
        else:
            before_hook(unraised)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    before_hook, sys.unraisablehook = sys.unraisablehook, unraisable
    try:
        yield raised
    finally:
        sys.unraisablehook = before_hook
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _tolerant_streams() -> Iterator[None]:
    """Make writes to closed output streams succeed silently.

    Writes to a closed stdout pipe and all failing writes to stderr are dropped.
    """
    _open_standard_files()
    before = sys.stdout, sys.stderr
    # Python sets a stream to None if the shell has closed it.
    with open(os.devnull, "w") as null:
        sys.stdout = stdout = _Stream(before[0] or null, BrokenPipeError)
        sys.stderr = _Stream(before[1] or null, OSError)
        try:
            yield
        finally:
            stdout.settle()
            sys.stdout, sys.stderr = before


def _open_standard_files() -> None:
    """Open the null device on the standard file descriptors that the shell has closed.

    Otherwise the next opened file would get one of their numbers, and libraries would print into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # os.open returns the lowest free descriptor, which is this one.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)


class _Stream:
    """Text stream that tolerates a closed reader and characters that the encoding lacks."""

    def __init__(self, stream: TextIO, ignored: type[OSError]) -> None:
        """Wrap ``stream``; after an error of the type ``ignored``, all output is dropped."""
        self._stream, self._ignored = stream, ignored

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write ``text``; characters that the encoding lacks are escaped."""
        try:
            return self._stream.write(text)
        except UnicodeEncodeError as error:
            # A character that the encoding lacks, for example in a folder's name, must not abort a run after hours of
            # work.
            return self._stream.write(text.encode(error.encoding, "backslashreplace").decode(error.encoding))
        except self._ignored:
            self._silence()
            return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        try:
            self._stream.flush()
        except self._ignored:
            self._silence()

    def settle(self) -> None:
        """Flush; if that fails, drop the buffered output so that Python does not write it at exit."""
        try:
            self._stream.flush()
        except OSError:
            self._silence()

    def _silence(self) -> None:
        # Redirect the stream to the null device, so that buffered output is dropped now and when Python exits.
        with contextlib.suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)

"""Commands of egs_warp that the page of ``egs-warp pick`` starts, each in a process of its own."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from typing import IO, Any

_ADDRESS = re.compile(r"open (http://127\.0\.0\.1:\d+/\S*)")
"""Beginning of the line in which a command states the address of its page."""
_STAGE = re.compile(r"(?P<what>[^:|]+: [^|]+), [\d:]+<(?P<left>\?|[\d:]+)")
_COUNT = re.compile(r"(?P<what>[^:|]+): +\d+%\|.*\| *(?P<done>\d+/\d+) \[[\d:]+<(?P<left>\?|[\d:]+).*")
_START = re.compile(r"(?P<what>[^:|]+): +\d+[a-z]+ \[.*")
"""Patterns of the progress bars of the commands (``egs_warp/pipelines/progress.py`` and tqdm)."""
_MAX_LINE = 400
"""Maximum number of characters of a line that is sent to the page."""
_EXIT_TIME = 5.0
"""Time within which a command must end after a signal, s."""


class Job:
    """A running command. Its output is printed on the terminal; progress, its last line and the address of its page are
    reported."""

    def __init__(
        self,
        arguments: Sequence[str],
        *,
        on_line: Callable[[str], object],
        on_address: Callable[[str], object],
        on_end: Callable[[int, str], object],
    ) -> None:
        """Start ``egs-warp`` with ``arguments``.

        Args:
            arguments: the command and its flags.
            on_line: called with each line of progress, until the command serves a page, which shows it itself.
            on_address: called with the address of a page that the command serves.
            on_end: called with the exit status and the last line.
        """
        self._on_line, self._on_address, self._on_end = on_line, on_address, on_end
        self._last, self._is_serving = "", False
        self._reporting = threading.Lock()
        options: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self._process = subprocess.Popen([sys.executable, "-m", "egs_warp.cli", *arguments], **options)
        streams = (self._process.stdout, self._process.stderr)
        self._readers = [threading.Thread(target=self._read, args=(stream,), daemon=True) for stream in streams]
        for reader in self._readers:
            reader.start()
        threading.Thread(target=self._wait, name="job", daemon=True).start()

    @property
    def is_running(self) -> bool:
        """True until the command has ended."""
        return self._process.poll() is None

    def stop(self) -> None:
        """Signal the command to end, and wait until it has ended."""
        if not self.is_running:
            return
        self._process.terminate()
        try:
            self._process.wait(_EXIT_TIME)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _read(self, stream: IO[bytes]) -> None:
        """Report the lines of ``stream``; a progress bar ends its lines with a carriage return."""
        line = bytearray()
        while byte := stream.read(1):
            if byte not in b"\r\n":
                line += byte
                continue
            text = line.decode(errors="replace").strip()[:_MAX_LINE]
            line.clear()
            if not text:
                continue
            if byte == b"\n":
                print(text, file=sys.stderr, flush=True)
            address = _ADDRESS.match(text)
            with self._reporting:
                if address is not None:
                    self._is_serving = True
                    self._on_address(address[1])
                elif text != "end with Ctrl-C":
                    self._last = text
                    if not self._is_serving:
                        self._on_line(progress_text(text))

    def _wait(self) -> None:
        status = self._process.wait()
        for reader in self._readers:
            reader.join()
        self._on_end(status, self._last)


def progress_text(bar: str) -> str:
    """Return the text of a progress ``bar`` for a page: the stage or count, and the remaining time, if it is known."""
    for pattern in (_STAGE, _COUNT, _START):
        match = pattern.fullmatch(bar)
        if match is not None:
            parts = match.groupdict()
            text = " ".join([parts["what"], *parts.get("done", "").replace("/", " of ").split()])
            left = parts.get("left", "?")
            return text if left == "?" else f"{text}, {_duration(left)} left"
    return bar


def _duration(clock: str) -> str:
    """Return a time such as ``1:02:03`` as a rounded number of seconds, minutes or hours."""
    seconds = 0
    for part in clock.split(":"):
        seconds = 60 * seconds + int(part)
    if seconds < 90:
        return f"{seconds} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"

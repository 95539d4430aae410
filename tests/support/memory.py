"""The most memory that this process has held (Linux).

Not ``ru_maxrss``, which a child begins with that of the process that started it: beside a large one it never grows.
"""

from __future__ import annotations

from pathlib import Path


def reset_peak() -> None:
    """From now on the peak is that of what is held now and later."""
    Path("/proc/self/clear_refs").write_text("5")


def peak_bytes() -> int:
    """Of resident memory."""
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:")]
    return 1024 * int(line.split()[1])

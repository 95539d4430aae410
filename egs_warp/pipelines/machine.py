"""Inspection of the machine, and compilation of all kernels before their first use."""

from __future__ import annotations

import importlib
import os
import pkgutil
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warp as wp

from egs_warp import kernels
from egs_warp.errors import UserError
from egs_warp.installation import install_command
from egs_warp.io.video import ffmpeg_program
from egs_warp.launching import available_threads
from egs_warp.pipelines.report import MECHANICS, installed_version, versions

OPTIONAL = {
    "torch": ("training, and fine-tuning of Gaussians that straddle the ground", "torch"),
    "pycolmap": ("egs-warp pose", "pose"),
    "usd-core": ("exports to USD", "usd"),
    "anywidget": ("egs.show in notebooks", "notebook"),
    "gymnasium": ("environments of many worlds", "gymnasium"),
    "ray": ("runs on the hosts of a cluster", "ray"),
}
"""Purpose of each optional package, and the extra that installs the package."""
_ENCODERS = {"libx264": "mp4", "prores_ks": "ProRes 4444", "libvpx-vp9": "WebM with alpha"}
_MIN_FREE_MEMORY = 2**31
"""Memory that a scene of half a million Gaussians and a body need, bytes."""
_BLOCK_SIZE = 256
"""Warp's default block size on a GPU; a kernel file with another block size defines ``BLOCK``."""

_MAX_COMPILERS = 8
"""Maximum number of kernel files that are compiled at the same time."""
_MAX_END_TIME = 2.0
"""Time after which a background process that has not ended is killed, s."""
_END_WITH_PARENT = (
    "import os, threading; threading.Thread(target=lambda: (os.read(0, 1), os._exit(1)), daemon=True).start()\n"
)
"""Python text that ends its process as soon as its standard input is closed. The thread reads the file descriptor
itself, because a buffered reader is locked when the process ends normally."""


@dataclass(frozen=True)
class DeviceFacts:
    """Properties of one Warp device."""

    alias: str
    """Warp's name of the device, such as ``cpu`` or ``cuda:0``."""
    name: str
    free: int | None
    """Free memory, bytes; None if the system does not report it."""
    total: int | None
    """Total memory, bytes; None if the system does not report it."""
    compiled: int
    """Number of kernel files that are in the cache, compiled for this device from the current sources."""
    files: int
    """Number of kernel files that can run on the device."""


@dataclass(frozen=True)
class Machine:
    """Properties of the machine, its problems, and advice."""

    system: str
    versions: dict[str, str]
    optional: dict[str, str | None]
    """Versions of the packages in ``OPTIONAL``; None for a missing one."""
    driver: str | None
    """Newest CUDA version that NVIDIA's driver supports; None without a driver."""
    toolkit: str
    """CUDA version that Warp was built with."""
    cores: int
    devices: tuple[DeviceFacts, ...]
    cache: Path
    cache_bytes: int
    ffmpeg: str | None
    encoders: tuple[str, ...]
    """Video formats that the installed ffmpeg can write."""
    problems: tuple[str, ...]
    """Problems that prevent the package from working."""
    advice: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the lines for the terminal."""
        lines = [f"system   {self.system}, {self.cores} cores"]
        lines.append(f"versions {', '.join(f'{name} {number}' for name, number in self.versions.items())}")
        optional = [f"{name} {number}" if number else f"no {name}" for name, number in self.optional.items()]
        lines.append(f"optional {', '.join(optional)}")
        driver = f"supports CUDA {self.driver}" if self.driver else "none"
        lines.append(f"driver   NVIDIA: {driver}; Warp was built with CUDA {self.toolkit}")
        for device in self.devices:
            memory = f"{_gib(device.free)} of {_gib(device.total)} GiB free"
            lines.append(f"device   {device.alias}: {device.name}, {memory}, kernels {device.compiled}/{device.files}")
        lines.append(f"cache    {self.cache} ({self.cache_bytes / 1e6:.0f} MB)")
        lines.append(f"ffmpeg   {self.ffmpeg or 'none'}{': ' if self.encoders else ''}{', '.join(self.encoders)}")
        lines += [f"problem  {line}" for line in self.problems]
        return lines + [f"to do    {line}" for line in self.advice]


def inspect_machine() -> Machine:
    """Inspect devices, versions, cache and ffmpeg. Call ``use_device`` first. This function installs and writes
    nothing."""
    driver, toolkit = wp.get_cuda_driver_version(), wp.get_cuda_toolkit_version()
    devices = tuple(_device_facts(device) for device in wp.get_devices())
    cache = Path(wp.config.kernel_cache_dir or ".")
    optional = {name: installed_version(name) for name in OPTIONAL}
    problems, advice = [], []
    if not os.access(cache, os.W_OK):
        problems.append(f"kernel cache {cache}: is not writable; set WARP_CACHE_PATH to a writable folder")
    ffmpeg, encoders = None, ()
    try:
        ffmpeg = ffmpeg_program()
        encoders = _encoders(ffmpeg)
    except UserError as error:
        problems.append(error.format_message())
    if len(devices) == 1:
        advice.append("everything runs on the CPU; the device cuda:0 needs an NVIDIA GPU and its driver")
    for device in devices:
        if device.free is not None and device.free < _MIN_FREE_MEMORY:
            advice.append(f"{device.alias} has little free memory: end other programs, or give smaller captures")
    for name, (use, extra) in OPTIONAL.items():
        if optional[name] is None:
            advice.append(f"for {use}: {install_command(extra)}")
    if not (Path(kernels.__file__).parents[1] / "web/page.html").is_file():
        advice.append("for egs-warp view: run make web in the source tree (node 20 or newer), or install the wheel")
    return Machine(
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        versions=versions(MECHANICS),
        optional=optional,
        driver=".".join(map(str, driver)) if driver else None,
        toolkit=".".join(map(str, toolkit)) if toolkit else "none",
        cores=available_threads(),
        devices=devices,
        cache=cache,
        cache_bytes=sum(file.stat().st_size for file in cache.rglob("*") if file.is_file()),
        ffmpeg=ffmpeg,
        encoders=encoders,
        problems=tuple(problems),
        advice=tuple(advice),
    )


def compile_kernels(device: str, *, progress: Callable[[str, int, int], object] = lambda name, done, of: None) -> None:
    """Compile all kernels of the package for ``device`` that are not in the cache. Call ``use_device`` first.

    ``progress`` is called after each file with its name, the number of files finished before it, and the total number
    of files.
    """
    target: wp.Device = wp.get_device(device)
    files = _kernel_files(target)

    def load(file: Any) -> str:
        wp.load_module(file.__name__, device=target, block_dim=_block(file, target))
        return file.__name__.removeprefix(f"{kernels.__name__}.")

    # The compilers run outside of Python's lock.
    with ThreadPoolExecutor(min(available_threads(), _MAX_COMPILERS)) as pool:
        for done, name in enumerate(pool.map(load, files)):
            progress(name, done, len(files))
    progress("all", len(files), len(files))


@contextmanager
def compiling_in_background(device: str) -> Iterator[subprocess.Popen[bytes]]:
    """Context in which a second process compiles all kernels for ``device`` into the cache, so that the later stages of
    this process need not compile theirs. The process ends with the context, also if this process is killed.

    On a GPU, the second process has a CUDA context and the compiled kernels of its own in the memory of the device.
    """
    program = (
        "from egs_warp.launching import use_device; from egs_warp.pipelines.machine import compile_kernels;"
        f" use_device({device!r}); compile_kernels({device!r})"
    )
    with background_process(program) as process:
        yield process


@contextmanager
def background_process(program: str) -> Iterator[subprocess.Popen[bytes]]:
    """Context in which a second process runs the Python text ``program`` without input and output. It ends with the
    context, also if this process is killed: then its input is closed, which a thread of it waits for."""
    command = [sys.executable, "-c", _END_WITH_PARENT + program]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.terminate()
        try:
            process.wait(_MAX_END_TIME)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _kernel_files(device: wp.Device) -> list[Any]:
    """Return the kernel modules that ``device`` can run, sorted by name."""
    names = sorted(found.name for found in pkgutil.walk_packages(kernels.__path__, f"{kernels.__name__}."))
    # Native CUDA code cannot be compiled for a CPU.
    files = [importlib.import_module(name) for name in names if device.is_cuda or not name.endswith("_cuda")]
    return [file for file in files if wp.get_module(file.__name__).kernels]


def _block(file: Any, device: wp.Device) -> int:
    return getattr(file, "BLOCK", _BLOCK_SIZE) if device.is_cuda else 1


def _device_facts(device: wp.Device) -> DeviceFacts:
    files = _kernel_files(device)
    folder = Path(wp.config.kernel_cache_dir or ".")
    compiled = 0
    for file in files:
        name = wp.get_module(file.__name__).get_module_identifier(_block(file, device))
        kinds = (".sm*.cubin", ".sm*.ptx") if device.is_cuda else (".o",)
        compiled += any(any((folder / name).glob(f"*{kind}")) for kind in kinds)
    free, total = (device.free_memory, device.total_memory) if device.is_cuda else _host_memory()
    name = device.name if device.is_cuda else _processor()
    return DeviceFacts(device.alias, name, free, total, compiled, len(files))


def _host_memory() -> tuple[int | None, int | None]:
    """Return available and total memory of the host, bytes; None except on Linux."""
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        free, total = (1024 * int(lines[name].split()[0]) for name in ("MemAvailable", "MemTotal"))
        return free, total
    except (OSError, KeyError, ValueError):
        return None, None


def _processor() -> str:
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1].strip() if found else platform.processor() or platform.machine()


def _encoders(program: str) -> tuple[str, ...]:
    done = subprocess.run(
        [program, "-hide_banner", "-encoders"], stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    return tuple(kind for name, kind in _ENCODERS.items() if f" {name} " in done.stdout)


def _gib(size: int | None) -> str:
    return "?" if size is None else f"{size / 2**30:.1f}"

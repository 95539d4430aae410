"""The command that installs an extra, in a module that imports only Python's own."""

from __future__ import annotations

import re
import shutil
import sys
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

_DISTRIBUTION = "egs-warp"
_BELOW_PYTHON = re.compile(r"""python_version\s*<\s*["'](\d+)\.(\d+)["']""")
_SHELL_SAFE = re.compile(r"[\w./:\\~-]+")


def install_command(extra: str) -> str:
    """Return the command that installs the packages of ``extra`` into the environment of this process.

    In a checkout this is pip's editable installation of the checkout with the extra. For an installed wheel, whose
    file may be gone, it names the packages of the extra. It does not name egs-warp, which no package index has. If no
    package of the extra exists for this Python, the text says so instead.
    """
    pip, packages = _pip(), _packages(extra)
    if packages and not any(map(_is_for_this_python, packages)):
        return f"not available for Python {sys.version_info.major}.{sys.version_info.minor}"
    checkout = Path(__file__).resolve().parents[1]
    if (checkout / "pyproject.toml").is_file():
        return f'{pip} install -e "{"." if _is_current_folder(checkout) else checkout}[{extra}]"'
    return " ".join([pip, "install", *(f'"{package}"' for package in packages)])


def _is_current_folder(folder: Path) -> bool:
    try:
        return folder == Path.cwd()
    except OSError:
        # The current folder has been removed.
        return False


def _is_for_this_python(package: str) -> bool:
    """Return False if a condition ``python_version < 'X.Y'`` of a requirement excludes this Python."""
    limit = _BELOW_PYTHON.search(package)
    return limit is None or sys.version_info[:2] < (int(limit[1]), int(limit[2]))


def _pip() -> str:
    """Return how a shell starts pip for this environment: by its name only if that finds the one of this Python."""
    found = shutil.which("pip")
    if found is not None and Path(found).parent == Path(sys.executable).parent:
        return "pip"
    python = sys.executable or "python"
    return (python if _SHELL_SAFE.fullmatch(python) else f'"{python}"') + " -m pip"


def _packages(extra: str) -> list[str]:
    """Return the requirements of ``extra`` as pip takes them, such as ``usd-core>=26.3``."""
    try:
        lines = requires(_DISTRIBUTION) or []
    except PackageNotFoundError:
        lines = []
    of_extra = re.compile(rf"""\s*(?:;|\band)?\s*\bextra\s*==\s*["']{re.escape(extra)}["']""")
    return [of_extra.sub("", line).replace('"', "'").strip() for line in lines if of_extra.search(line)]

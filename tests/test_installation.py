"""The printed command installs an extra in a checkout, from a wheel, and with a pip that is not on the path."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from egs_warp import installation
from egs_warp.installation import install_command

PYTHON = f"{sys.executable} -m pip"


@pytest.fixture(autouse=True)
def _other_pip(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/other/bin/{name}")


def test_a_checkout_is_installed_in_place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tree = Path(installation.__file__).resolve().parents[1]
    monkeypatch.chdir(tree)
    assert install_command("pose") == f'{PYTHON} install -e ".[pose]"'
    other = f'{PYTHON} install -e "{tree}[pose]"'
    monkeypatch.chdir(tmp_path)
    assert install_command("pose") == other

    def removed() -> Path:
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr(Path, "cwd", removed)
    assert install_command("pose") == other


def test_an_installed_wheel_gets_the_packages_of_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No package index has egs-warp: its name must not be installed."""
    lines = [
        "numpy>=1.26",
        'gymnasium>=1.1; extra == "gymnasium"',
        "torch>=2.8 ; extra == 'gymnasium'",
        'rembg>=0.1; python_version < "4.0" and extra == "salient"',
        'oldest>=0.1; python_version < "3.5" and extra == "old"',
    ]
    monkeypatch.setattr(installation, "__file__", str(tmp_path / "site-packages/egs_warp/installation.py"))
    monkeypatch.setattr(installation, "requires", {"egs-warp": lines}.__getitem__)
    assert install_command("gymnasium") == f'{PYTHON} install "gymnasium>=1.1" "torch>=2.8"'
    assert install_command("salient") == f"{PYTHON} install \"rembg>=0.1; python_version < '4.0'\""
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert install_command("old") == f"not available for Python {version}"


def test_pip_is_named_alone_where_the_shell_finds_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: str(Path(sys.executable).parent / name))
    assert install_command("pose").startswith("pip install -e ")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setattr(sys, "executable", "/my tools/python")
    assert install_command("pose").startswith('"/my tools/python" -m pip install ')


def test_no_text_installs_the_package_by_its_name() -> None:
    tree = Path(__file__).parents[1]
    files = [*tree.glob("*.md"), *tree.glob("docs/**/*.md"), *tree.glob("docs/*.ipynb"), *tree.glob("egs_warp/**/*.py")]
    named = [
        f"{file.relative_to(tree)}: {line.strip()}"
        for file in files
        for line in file.read_text().splitlines()
        if "install" in line and "egs-warp[" in line and "Do not install" not in line
    ]
    assert not named

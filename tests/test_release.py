"""Release files: the bill of materials, with every package, hash and dependency, and consistent version numbers."""

from __future__ import annotations

import hashlib
import json
import re
import runpy
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from egs_warp.version import __version__

ROOT = Path(__file__).parents[1]
RELEASE = runpy.run_path(str(ROOT / ".ci" / "release.py"))
PINNED = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line)


def entry(name: str, version: str, digest: str, needs: list[str], **more: Any) -> dict[str, Any]:
    archive = {"archive_info": {"hashes": {"sha256": digest}}}
    return {"metadata": {"name": name, "version": version, "requires_dist": needs, **more}, "download_info": archive}


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    path = tmp_path / "egs_warp-0.1.0-py3-none-any.whl"
    path.write_bytes(b"a wheel")
    return path


def reports() -> list[dict[str, Any]]:
    """Return reports in pip's format for this platform and for another one, on which one package has another file."""
    own = {"metadata": {"name": "egs_warp", "version": "0.1.0", "requires_dist": ["NumPy>=1.26", "scipy>=1.12"]}}
    scipy = entry("scipy", "1.17.1", "b" * 64, ["numpy<3", 'pytest; extra == "test"'], license="BSD\n" * 40)
    here = [own, scipy, entry("numpy", "2.4.6", "a" * 64, [], license_expression="BSD-3-Clause")]
    return [{"install": here}, {"install": [own, scipy, entry("numpy", "2.4.6", "c" * 64, [])]}]


def test_requirements_list_every_package_with_its_hashes() -> None:
    expected = f"numpy==2.4.6 \\\n    --hash=sha256:{'a' * 64} \\\n    --hash=sha256:{'c' * 64}\n"
    expected += f"scipy==1.17.1 \\\n    --hash=sha256:{'b' * 64}\n"
    assert RELEASE["requirements_of"](reports()) == expected


def test_the_bill_of_materials_lists_every_component_and_its_dependents(wheel: Path) -> None:
    lock = json.loads((ROOT / "egs_warp" / "web" / "client" / "package-lock.json").read_text())
    bill = RELEASE["bill_of"](wheel, reports(), lock)
    assert (bill["bomFormat"], bill["specVersion"], bill["version"]) == ("CycloneDX", "1.6", 1)
    assert re.fullmatch(r"urn:uuid:[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", bill["serialNumber"])
    itself = bill["metadata"]["component"]
    assert itself["hashes"] == [{"alg": "SHA-256", "content": hashlib.sha256(b"a wheel").hexdigest()}]
    parts = {part["bom-ref"]: part for part in bill["components"]}
    assert parts["pkg:pypi/numpy@2.4.6"]["licenses"] == [{"license": {"name": "BSD-3-Clause"}}]
    assert "licenses" not in parts["pkg:pypi/scipy@1.17.1"]
    page = {part["name"]: part for part in parts.values() if part["purl"].startswith("pkg:npm/")}
    # The libraries are those that THIRD_PARTY.md lists.
    assert set(page) == {"three", "@sparkjsdev/spark", "fflate", "mediabunny"}
    for name, part in page.items():
        assert f"{part['version']}" in (ROOT / "THIRD_PARTY.md").read_text(), name
        assert part["hashes"][0]["alg"] == "SHA-512" and len(part["hashes"][0]["content"]) == 128
    needs = {one["ref"]: one["dependsOn"] for one in bill["dependencies"]}
    assert set(needs[itself["bom-ref"]]) == set(parts)
    assert needs["pkg:pypi/scipy@1.17.1"] == ["pkg:pypi/numpy@2.4.6"]
    assert RELEASE["bill_of"](wheel, reports(), lock) == bill


def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_all_files_state_the_version() -> None:
    recipe = yaml.safe_load((ROOT / "docs" / "conda" / "recipe.yaml").read_text())
    assert recipe["context"]["version"] == __version__
    assert recipe["context"]["python_min"] == project()["requires-python"].removeprefix(">=")
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text()
    manifest = tomllib.loads((ROOT / "egs_warp" / "blender" / "blender_manifest.toml").read_text())
    assert manifest["version"] == __version__
    player = ROOT / "egs_warp" / "web" / "player" / "package.json"
    assert json.loads(player.read_text())["version"] == __version__
    assert f"egs_warp-{__version__}-py3-none-any.whl" in (ROOT / "docs" / "guide" / "install.md").read_text()


def test_the_conda_recipe_requires_what_the_wheel_requires() -> None:
    recipe = yaml.safe_load((ROOT / "docs" / "conda" / "recipe.yaml").read_text())
    names = {"py-opencv": "opencv-python-headless", "matplotlib-base": "matplotlib"}
    run = [line.split(" ") for line in recipe["requirements"]["run"] if not line.startswith("python ")]
    assert [names.get(name, name) + bound for name, bound in run] == project()["dependencies"]


def test_the_table_of_extras_is_complete() -> None:
    page = (ROOT / "docs" / "guide" / "install.md").read_text()
    rows = re.findall(r"^\| (`.*?`) \|", page.partition("| extra |")[2].partition("\n\n")[0], re.MULTILINE)
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == set(project()["optional-dependencies"])


def test_every_dependency_is_pinned() -> None:
    """Check the dependencies of the package and of all extras in ``pyproject.toml``."""
    extras = project()["optional-dependencies"].values()
    asked = [*project()["dependencies"], *(line for extra in extras for line in extra)]
    names = {RELEASE["canonical"](re.match(r"[\w.-]+", line).group()) for line in asked}  # pyright: ignore[reportOptionalMemberAccess]
    assert names <= {RELEASE["canonical"](name) for name in PINNED}

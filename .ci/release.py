"""Files of a release besides the wheel: a bill of materials (CycloneDX 1.6) and requirements with hashes of every file.

``make release`` writes both to ``out/dist``. They list the packages that pip would install with the wheel under
``constraints.txt``, on this machine's platform and on others (``--also win_amd64:3.12``), and the packages in the lock
file of the page. The hashes are those of pip's index. With these files a user installs exactly the tested versions:

    pip install --require-hashes -r egs_warp-VERSION-requirements.txt
    pip install --no-deps egs_warp-VERSION-py3-none-any.whl
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import hashlib
import json
import re
import subprocess
import sys
import tempfile
import uuid
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "egs_warp" / "web" / "client" / "package-lock.json"
_MAX_LICENCE_LENGTH = 60
"""Maximum length in characters; some packages put the whole text into the field of its name."""


def main() -> int:
    """Write the files; returns 1 if there is not exactly one wheel, or if pip finds no files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--dist", type=Path, default=ROOT / "out" / "dist", help="folder of the wheel (default %(default)s)"
    )
    parser.add_argument(
        "--also", action="append", default=[], metavar="PLATFORM:PYTHON", help="also add hashes for this platform"
    )
    chosen = parser.parse_args()
    wheels = sorted(chosen.dist.glob("egs_warp-*.whl"))
    if len(wheels) != 1:
        print(f"{chosen.dist}: {len(wheels)} wheels of egs_warp; make build writes one", file=sys.stderr)
        return 1
    (wheel,) = wheels
    try:
        reports = [report_of(wheel), *(report_of(wheel, target) for target in chosen.also)]
    except subprocess.CalledProcessError as error:
        errors = [line for line in error.stderr.splitlines() if line.startswith("ERROR")]
        print(errors[-1] if errors else error, file=sys.stderr)
        return 1
    name = "-".join(wheel.name.split("-")[:2])
    bill = chosen.dist / f"{name}.cdx.json"
    bill.write_text(json.dumps(bill_of(wheel, reports, json.loads(LOCK.read_text())), indent=1) + "\n")
    requirements = chosen.dist / f"{name}-requirements.txt"
    requirements.write_text(requirements_of(reports))
    print(f"{bill}\n{requirements}: {len(installed(reports[0]))} packages")
    return 0


def report_of(wheel: Path, target: str | None = None) -> dict[str, Any]:
    """Return pip's report of installing ``wheel`` into an empty environment of this machine, or of ``target``."""
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed"]
    command += ["--disable-pip-version-check", "--report", "-", "-c", str(ROOT / "constraints.txt")]
    with tempfile.TemporaryDirectory() as nowhere:
        if target is not None:
            platform, python = target.split(":")
            command += ["--platform", platform, "--python-version", python, "--only-binary=:all:", "--target", nowhere]
        return json.loads(subprocess.run([*command, str(wheel)], check=True, capture_output=True, text=True).stdout)


def installed(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the packages of a report that come from the index, all but egs_warp itself, sorted by name."""
    others = [one for one in report["install"] if canonical(one["metadata"]["name"]) != "egs-warp"]
    return sorted(others, key=lambda one: canonical(one["metadata"]["name"]))


def canonical(name: str) -> str:
    """Return the normalised name of a package."""
    return re.sub(r"[-_.]+", "-", name).lower()


def hash_of(one: dict[str, Any]) -> str:
    """Return the SHA-256 of the file that would be installed."""
    return one["download_info"]["archive_info"]["hashes"]["sha256"]


def requirements_of(reports: list[dict[str, Any]]) -> str:
    """Return a requirements file: every package once, with the hashes of its files on all platforms."""
    pinned: dict[str, list[str]] = {}
    for one in (one for report in reports for one in installed(report)):
        known = pinned.setdefault(f"{canonical(one['metadata']['name'])}=={one['metadata']['version']}", [])
        if hash_of(one) not in known:
            known.append(hash_of(one))
    lines = [" \\\n".join([name, *(f"    --hash=sha256:{known}" for known in pinned[name])]) for name in sorted(pinned)]
    return "\n".join(lines) + "\n"


def bill_of(wheel: Path, reports: list[dict[str, Any]], lock: dict[str, Any]) -> dict[str, Any]:
    """Return the CycloneDX document of egs_warp, its installed packages, those of its page, and the dependencies."""
    _, version, *_ = wheel.name.split("-")
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    itself = {
        "type": "application",
        "bom-ref": f"pkg:pypi/egs-warp@{version}",
        "name": "egs-warp",
        "version": version,
        "purl": f"pkg:pypi/egs-warp@{version}",
        "licenses": [{"license": {"id": "Apache-2.0"}}],
        "hashes": [{"alg": "SHA-256", "content": digest}],
    }
    python, page = installed(reports[0]), bundled(lock)
    references = {canonical(one["metadata"]["name"]): reference(one) for one in python}
    own = next(one for one in reports[0]["install"] if canonical(one["metadata"]["name"]) == "egs-warp")
    needs = [
        {"ref": itself["bom-ref"], "dependsOn": [*needed(own, references), *(part["bom-ref"] for part in page)]},
        *({"ref": reference(one), "dependsOn": needed(one, references)} for one in python),
    ]
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, digest)}",
        "version": 1,
        "metadata": {"component": itself},
        "components": [*(component(one) for one in python), *page],
        "dependencies": needs,
    }


def reference(one: dict[str, Any]) -> str:
    """Return the package URL of a Python package."""
    return f"pkg:pypi/{canonical(one['metadata']['name'])}@{one['metadata']['version']}"


def component(one: dict[str, Any]) -> dict[str, Any]:
    """Return the CycloneDX component of a Python package."""
    metadata = one["metadata"]
    licence = licence_of(metadata)
    return {
        "type": "library",
        "bom-ref": reference(one),
        "name": canonical(metadata["name"]),
        "version": metadata["version"],
        "purl": reference(one),
        **({"licenses": [{"license": {"name": licence}}]} if licence else {}),
        "hashes": [{"alg": "SHA-256", "content": hash_of(one)}],
    }


def licence_of(metadata: dict[str, Any]) -> str:
    """Return the shortest name of the licence in the metadata."""
    licence = metadata.get("license_expression") or metadata.get("license") or ""
    if licence and "\n" not in licence and len(licence) <= _MAX_LICENCE_LENGTH:
        return licence
    # Older versions of pip do not report licence expressions; the installed metadata have them.
    with contextlib.suppress(PackageNotFoundError):
        local = distribution(metadata["name"])
        if local.version == metadata["version"] and "License-Expression" in local.metadata:
            return local.metadata["License-Expression"]
    classes = [line.split(" :: ")[-1] for line in metadata.get("classifier", ()) if line.startswith("License :: ")]
    return " AND ".join(name for name in classes if name != "OSI Approved")


def needed(one: dict[str, Any], references: dict[str, str]) -> list[str]:
    """Return the entries of ``references`` that a package requires."""
    requirements = (
        re.match(r"[\w.-]+", line) for line in one["metadata"].get("requires_dist", ()) if "extra ==" not in line
    )
    names = {canonical(match.group()) for match in requirements if match}
    return sorted(references[name] for name in names if name in references)


def bundled(lock: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the components of the page: the npm packages that are neither development tools nor type declarations."""
    found = []
    for path, entry in sorted(lock["packages"].items()):
        if not path or entry.get("dev") or "/@types/" in path:
            continue
        name = path.split("node_modules/")[-1]
        kind, digest = entry["integrity"].split("-", 1)
        url = f"pkg:npm/{name.replace('@', '%40')}@{entry['version']}"
        found.append(
            {
                "type": "library",
                "bom-ref": url,
                "name": name,
                "version": entry["version"],
                "purl": url,
                **({"licenses": [{"license": {"name": entry["license"]}}]} if "license" in entry else {}),
                "hashes": [{"alg": kind.upper().replace("SHA", "SHA-"), "content": base64.b64decode(digest).hex()}],
            }
        )
    return found


if __name__ == "__main__":
    sys.exit(main())

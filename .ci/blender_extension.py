"""Build the Blender extension: a zip of ``egs_warp/blender``, the reader of bundles and the licence.

Usage: python .ci/blender_extension.py [FOLDER], by default out/dist. The same tree gives the same bytes.
"""

from __future__ import annotations

import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "egs_warp" / "blender"


def build(folder: Path) -> Path:
    """Write the extension into ``folder``; return its path."""
    manifest = tomllib.loads((SOURCES / "blender_manifest.toml").read_text())
    files = [*SOURCES.glob("*.py"), SOURCES / "blender_manifest.toml", ROOT / "examples" / "read_bundle.py"]
    files.append(ROOT / "LICENSE")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{manifest['id']}-blender-{manifest['version']}.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(files, key=lambda file: file.name):
            archive.writestr(zipfile.ZipInfo(file.name), file.read_bytes(), zipfile.ZIP_DEFLATED)
    return path


if __name__ == "__main__":
    print(build(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "out" / "dist"))

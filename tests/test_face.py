"""Public interface of ``egs_warp``: small, imported lazily, complete, and as documented in the README and in docs."""

from __future__ import annotations

import ast
import dataclasses
import difflib
import inspect
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egs_warp as egs
from egs_warp import io

ROOT = Path(__file__).parents[1]
FACE = ROOT / "egs_warp" / "__init__.py"
PACKAGE_CLASSES = {
    node.name
    for path in (ROOT / "egs_warp").rglob("*.py")
    for node in ast.parse(path.read_text()).body
    if isinstance(node, ast.ClassDef)
}


def readme_lines() -> str:
    """Return the Python code of the README."""
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    return block


def test_the_public_names_are_documented() -> None:
    rows = re.findall(r"^\| (`.*?) \|", (ROOT / "docs" / "reference" / "face.md").read_text(), re.MULTILINE)
    taught = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(taught) == sorted(egs.__all__) == dir(egs)
    for name in egs.__all__:
        assert getattr(egs, name).__doc__, name
    with pytest.raises(AttributeError, match=r"^module 'egs_warp' has no attribute 'wxyz'$"):
        egs.wxyz  # noqa: B018
    for name in ("read_captur", "Trajectry", "simulat"):
        (near,) = difflib.get_close_matches(name, egs.__all__, n=1)
        with pytest.raises(AttributeError, match=rf"'{name}' \(did you mean '{near}'\?\)"):
            getattr(egs, name)


def classes_of(annotation: object) -> list[set[str]]:
    """Return the classes of the package in each alternative of an annotation except None, without limits of numbers."""
    alternatives = re.split(r"\|(?![^\[]*\])", str(annotation))
    return [
        set(re.findall(r"\w+", text)) & PACKAGE_CLASSES - {"Range"} for text in alternatives if text.strip() != "None"
    ]


def test_arguments_of_public_functions_are_public() -> None:
    """Each parameter of a public function accepts a type that consists of public classes or of records that a public
    function returns. So does each parameter of the constructor of a class that no function returns."""
    public: dict[str, Any] = {name: getattr(egs, name) for name in egs.__all__}
    functions: dict[str, Any] = {name: given for name, given in public.items() if inspect.isfunction(given)}
    returned = [inspect.signature(one).return_annotation for one in functions.values()]
    given = {name for annotation in returned for names in classes_of(annotation) for name in names}
    makers: dict[str, Any] = {
        name: one for name, one in public.items() if dataclasses.is_dataclass(one) and name not in given
    }
    checked = 0
    for name, made in (functions | makers).items():
        for parameter in inspect.signature(made).parameters.values():
            alternatives = classes_of(parameter.annotation)
            checked += any(alternatives)
            assert any(needed <= given | set(public) for needed in alternatives), f"{name}({parameter})"
    assert checked > 40


def test_messages_name_functions_that_return_the_class() -> None:
    for name, function in egs.RETURNED_BY.items():
        returned = str(inspect.signature(getattr(egs, function)).return_annotation)
        # A capture is a cloud.
        assert name in re.findall(r"\w+", returned.replace("Capture", "Capture GaussianCloud")), name


def test_type_checkers_see_the_same_names_in_the_same_modules() -> None:
    (block,) = [node for node in ast.parse(FACE.read_text()).body if isinstance(node, ast.If)]
    seen = {alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == egs._MODULE_OF
    assert FACE.with_name("py.typed").exists()


def test_importing_the_face_imports_nothing_else() -> None:
    code = "import sys, egs_warp; print(*sorted(name.split('.')[0] for name in sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert not {"torch", "cv2", "warp", "numpy", "scipy"} & set(loaded.split())
    code += "; egs_warp.UserError; assert 'warp' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, capture_output=True)


def test_the_examples_import_only_the_public_names() -> None:
    for path in sorted((ROOT / "examples").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert not (node.module or "").startswith("egs_warp"), f"{path.name}: {node.module}"
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names if alias.name.startswith("egs_warp")]
                assert set(names) <= {"egs_warp"}, f"{path.name}: {names}"


def test_the_readme_shows_the_paper_in_fifteen_lines() -> None:
    assert sum(bool(line.strip()) for line in readme_lines().splitlines()) <= 15


@pytest.mark.slow
def test_the_lines_of_the_readme_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lines of the README are executed with a scene of the pawn and the floor near it, and with fewer frames. A
    video is written, and the pawn crouches."""
    room = egs.scene("pawn", device="cpu").whole()[0]
    near = np.linalg.norm(room.means.numpy()[:, :2], axis=1) < 1.2
    (tmp_path / "samples").mkdir()
    egs.write_ply(tmp_path / "samples" / "pawn_on_its_board.ply", room.subset(near))
    monkeypatch.chdir(tmp_path)
    simulate = egs.simulate
    monkeypatch.setattr(egs, "simulate", lambda creature, motion: simulate(creature, motion, frames=25))
    names: dict[str, object] = {}
    exec(compile(readme_lines(), "README.md", "exec"), names)
    performance = names["run"]
    assert isinstance(performance, egs.SimulatedRun) and len(performance.frames) == 25
    heights = performance.frames @ performance.place.ground.axes[2]
    assert heights[-1].max() < heights[0].max() - 0.005
    assert np.isfinite(performance.frames).all()
    assert (tmp_path / "jump.mp4").stat().st_size > 10_000
    # The frames have the shadow on the floor that a film of ``animate`` has.
    separated: Any = names["scene"]
    shaded, plain = (
        next(egs.render_frames(performance, 128, background=separated.background, shadow=shadow)).astype(int)
        for shadow in (True, False)
    )
    assert ((plain - shaded).max(axis=2) > 20).sum() > 50 and (shaded - plain).max() <= 1
    with pytest.raises(egs.UserError, match="size 8x8: give sides from 16 to 4096 pixels"):
        egs.render_frames(performance, 8)


def test_the_lazy_names_of_io_can_be_imported() -> None:
    assert set(io._MODULE_OF) == set(io.__all__)
    for name in io.__all__:
        assert getattr(io, name).__name__ == name

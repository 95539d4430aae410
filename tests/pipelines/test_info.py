"""Text and image of ``egs-warp info``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from egs_warp.assets import pawn, stool
from egs_warp.assets.object import BuiltInObject
from egs_warp.cli import main
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io import read_capture, write_ply
from egs_warp.meshing.body_gaussians import representatives
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.repertoire import MOTIONS
from egs_warp.pipelines.creature import CreatureOptions, initial_stance, make_creature
from egs_warp.pipelines.info import BodyInfo, CaptureExtent, draw_info, inspect_capture
from egs_warp.pipelines.locate_plane import locate_plane
from egs_warp.segmentation.object_spec import ObjectSpec

COLOURS = {1: (0xD6, 0x27, 0x28), 2: (0x1F, 0x77, 0xB4), 3: (0x2C, 0xA0, 0x2C), 4: (0xFF, 0x7F, 0x0E)}
"""RGB colours of the feet in the image, in the order of their numbers."""


def inspected(thing: BuiltInObject) -> BodyInfo:
    return inspect_capture(thing.cloud, plane=thing.plane, nodes=200)


@pytest.fixture(scope="module")
def chair() -> BodyInfo:
    up = np.array([0.0, 0.0, 1.0])
    cloud = stool(gaussian_count=5000).cloud
    return inspect_capture(cloud, capture=CaptureExtent.of(cloud, "chair.ply"), up=up, nodes=200, notes=("so",))


def test_a_chair_is_described_by_its_measurements(chair: BodyInfo) -> None:
    """The feet are numbered counterclockwise from straight ahead; the lengths of legs are in body heights."""
    assert chair.base is SupportKind.FEET and len(chair.feet) == 4
    soles = chair.soles() / chair.body.height
    assert np.sign(soles[:, :2]).astype(int).tolist() == [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    lines = chair.lines()
    assert lines[0] == f"capture  chair.ply: {chair.standing.gaussians.count} Gaussians"
    assert lines[1].startswith("extent   ") and ", middle " in lines[1]
    assert lines[2] == "up       0.00,0.00,1.00"
    assert lines[4].startswith("front    ") and "-1.00,0.00 (guessed: " in lines[4]
    height = float(lines[5].split()[1])
    assert height == pytest.approx(1.0, abs=0.06), "the stool is one unit tall"
    assert "stands   on 4 feet, numbered anticlockwise from straight ahead" in lines
    legs = [float(line.split("leg ")[1].split(",")[0]) for line in lines if line.startswith("  foot ")]
    assert legs == [pytest.approx(0.47, abs=0.06)] * 4
    assert f"{chair.muscles.fibre_count} fibres, {chair.muscles.segment_count} segments" in "\n".join(lines)
    assert lines[-1] == "note: so"


def test_all_motions_are_listed(chair: BodyInfo) -> None:
    no_branch = (
        "the body has no branch that is free, such as an arm, a tail or an ear; parts that touch the trunk do not count"
    )
    possible = dict.fromkeys(MOTIONS) | {"wave": f"{no_branch}; use nod, shake, look around, bow or groove"}
    assert chair.motions() == possible
    round_one = inspected(pawn(gaussian_count=3000))
    assert len(round_one.feet) == 1 and "stands   on one base" in round_one.lines()
    assert round_one.motions() == possible, "it waddles"
    assert f"{'jump':<14}yes" in round_one.lines()


def test_the_base_is_that_of_the_contact_points() -> None:
    """The cage is wider than the body, so a base from its nodes would be too large for a motion that a creature may
    perform."""
    thing = pawn(gaussian_count=3000)
    info = inspected(thing)
    creature = make_creature(thing.cloud, plane=thing.plane, options=CreatureOptions(nodes=200))
    bases = [place.ground.local(place.contact_points)[:, :2] for place in (info.place, initial_stance(creature))]
    low, high = ([np.round(each(base, axis=0), 2).tolist() for base in bases] for each in (np.min, np.max))
    assert low[0] == low[1] and high[0] == high[1]


def has_colour(picture: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture[:, :, ::-1].astype(int) - colour).max(axis=2) <= 2).sum() > 30)


@pytest.mark.slow
def test_the_picture_has_every_foot_in_its_colour(chair: BodyInfo, tmp_path: Path) -> None:
    draw_info(tmp_path / "info.png", chair)
    picture = cv2.imread(str(tmp_path / "info.png"))
    assert picture is not None and picture.shape == (1000, 2000, 3)
    for colour in COLOURS.values():
        assert has_colour(picture, colour)


def snake() -> GaussianCloud:
    """Create a bar whose length is ten times its height."""
    rng = np.random.default_rng(0)
    points = rng.uniform(size=(5000, 3)) * [1.0, 0.1, 0.1] - [0.5, 0.05, 0.0]
    count = len(points)
    sizes = np.full((count, 3), np.log(0.012))
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return GaussianCloud.from_numpy(points, turns, sizes, np.full(count, 4.0), np.zeros((count, 1, 3)), device="cpu")


def test_a_lying_body_has_no_feet_and_is_drawn(tmp_path: Path) -> None:
    info = inspect_capture(snake(), up=np.array([0.0, 0.0, 1.0]), nodes=150)
    assert info.feet == () and info.base is SupportKind.LYING
    assert "stands   on its length: it crawls" in info.lines()
    assert info.motions()["walk"] is None and info.motions()["turn"] is None
    assert abs(info.front.direction[0]) > 0.99 and "the body lies along this direction" in str(info.front.reason)
    draw_info(tmp_path / "info.png", info)
    assert (tmp_path / "info.png").stat().st_size > 20_000


def test_a_body_above_the_ground_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A cube that hangs above the ground by half of its height is refused. The command prints its extent first."""
    random = np.random.default_rng(0)
    means = random.uniform(-0.3, 0.3, (4000, 3))
    means[np.arange(4000), np.arange(4000) % 3] = 0.3 * random.choice([-1.0, 1.0], 4000)
    cloud = GaussianCloud.from_numpy(
        means + [0.0, 0.0, 0.6],
        np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1)),
        np.full((len(means), 3), np.log(0.006)),
        np.full(len(means), 3.0),
        np.zeros((len(means), 1, 3)),
    )
    ground = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
    with pytest.raises(UserError, match=r"hangs 0\.\d+ of its height above the ground that was given") as caught:
        inspect_capture(cloud, plane=ground, nodes=100)
    assert "\n" not in str(caught.value)
    write_ply(tmp_path / "cube.ply", cloud)
    assert main(["info", str(tmp_path / "cube.ply"), "--plane", "0,0,1,0"]) == 2
    assert capsys.readouterr().out.splitlines() == [
        f"capture  {tmp_path / 'cube.ply'}: 4000 Gaussians",
        "extent   -0.3,-0.3,0.3 to 0.3,0.3,0.9, middle 0,0,0.6",
    ]


def test_large_captures_are_measured_from_a_part(monkeypatch: pytest.MonkeyPatch) -> None:
    thing = pawn(gaussian_count=3000)
    monkeypatch.setattr("egs_warp.meshing.body_gaussians.MAX_GAUSSIANS", 1000)
    few = representatives(thing.cloud)
    assert few.count == 1000
    order = np.random.default_rng(0).permutation(thing.cloud.count)
    again = representatives(thing.cloud.subset(order))
    assert sorted(map(tuple, again.means.numpy())) == sorted(map(tuple, few.means.numpy()))
    info = inspect_capture(thing.cloud, plane=thing.plane, nodes=100)
    assert f"{thing.cloud.count} Gaussians" in info.lines()[0]
    assert info.notes[-1].startswith("the body is measured from ")


def test_the_command_prints_the_lines_and_writes_the_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    thing = pawn(gaussian_count=3000)
    write_ply(tmp_path / "pawn.ply", thing.cloud)
    flags = ["info", str(tmp_path / "pawn.ply"), "--up", "z"]
    assert main([*flags, "--front=-y", "--plot", str(tmp_path / "info.png")]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith(f"capture  {tmp_path / 'pawn.ply'}: ")
    assert any(line.startswith("front    ") and line.endswith("as given") for line in out)
    assert cv2.imread(str(tmp_path / "info.png")) is not None


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--plot", "info.jpg"], "--plot info.jpg: give a file name that ends in .png"),
        (["--up", "z", "--front", "0,0,1"], "--front 0,0,1: points up or down; give a direction along the ground"),
        (["--metres-per-unit", "-1"], "--metres-per-unit -1: give a number of metres from 1e-9 to 1e9"),
    ],
)
def test_bad_flags_end_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=500).cloud)
    assert main(["info", str(tmp_path / "pawn.ply"), *flags]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


@pytest.mark.data
def test_the_raised_arm_of_a_statue_is_not_its_head(data_dir: Path) -> None:
    """The arm of the narcissus touches its head and ends higher."""
    capture = read_capture(data_dir / "scenes/narcissus.sog")
    located = locate_plane(capture, ObjectSpec(point=np.array([0.0, -0.8, 0.0])), up=np.array([0.0, -1.0, 0.0]))
    info = inspect_capture(capture.subset(located.segmentation.object_mask), plane=located.plane)
    head, arm = (info.place.standing[part.nodes, 2] for part in info.parts)
    assert head.max() < 0.95 * info.body.height and arm.max() > 0.99 * info.body.height
    assert info.lines()[-1].startswith("note: the head is taken to be the part ")

"""Make every image of the documentation from the built-in captures: run the commands on the pages, and shrink their
output.

python docs/make_pictures.py [NAME ...] makes all images or the named ones; sources that exist in ``out`` are reused.
Making all images takes about half an hour on two cores.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.support.chromium import opened, started

ROOT = Path(__file__).parents[1]
ASSETS = ROOT / "docs" / "assets"
RECORDED, RECORDED_RATE = (720, 360), 20
"""Size in pixels of the window in which a page is recorded, and frames per second of the recording."""
SIDE_VIEW = """() => {
    const [viewer] = egs.viewers, { bounds } = viewer, centre = bounds.getCenter(viewer.centreOfMass);
    egs.player.seek(0);
    const from = viewer.centreOfMass;
    egs.player.seek(1e6);
    const ahead = viewer.centreOfMass.sub(from).setZ(0).normalize();
    const way = centre.clone().set(ahead.y + 0.35 * ahead.x, 0.35 * ahead.y - ahead.x, 0.3).normalize();
    viewer.setCamera(centre.clone().addScaledVector(way, 1.25 * bounds.min.distanceTo(bounds.max)), centre);
    egs.setLayer("path", true);
}"""
CAPTURES = "python examples/captures.py --out out/captures"
HOP = "python examples/hop.py --hops 3 --out out/hop"
TWIST = "python examples/twist.py --out out/twist"
JUMP = "python examples/jump.py --out out/jump"
WALK = 'egs-warp animate out/captures/stool_in_room.ply --up z --object 0,0,0.97 --motion "walk 0.6" --out out/stool'
SCENE = "egs-warp animate out/captures/figurine_in_room.ply --up z --object 0,0,0.5 --motion jump --out out/figurine"
WADDLE, CRAWL, TURN, GET_UP, DANCE = (
    f"python examples/{name}.py --out out/{name}" for name in ("waddle", "crawl", "turn", "get_up", "dance")
)
DUEL, STAIRS, BOARD = (f"python examples/{name}.py --out out/{name}" for name in ("duel", "stairs", "board"))
INFO = "egs-warp info out/captures/stool.ply --up z --plot out/info.png"
PHOTOS = "python docs/photo_sheets.py --out out/photos"
MUSCLES = "egs-warp muscles out/captures/pawn.ply --up z --plot out/muscles.png"


@dataclass(frozen=True)
class Picture:
    """A file of docs/assets."""

    name: str
    command: str
    """Command, shown on a page, that creates the source of the file."""
    source: str
    """Path of the source in ``out``."""
    width: int
    """Width, pixels."""
    at: float = 0.0
    """Fraction of the film's duration at which a still is taken."""
    sky: float = 0.0
    """Fraction of the height that is cropped at the top."""


@dataclass(frozen=True)
class Page:
    """A page of docs/assets/pages, which is not in git: ``egs-warp view RUN --export``."""

    run: str
    """Folder of the run in ``out``, and name of the page."""
    command: str
    """Command that makes the run."""


PAGES = (Page("hop", HOP), Page("jump", JUMP), Page("twist", TWIST), Page("stool", WALK), Page("figurine", SCENE))
PICTURES = (
    Picture("hop.mp4", HOP, "hop/hop.mp4", 512, sky=0.16),
    Picture("hop_loop.webp", HOP, "hop/page.mp4", 400),
    Picture("hop.webp", HOP, "hop/hop.mp4", 512, at=0.18, sky=0.16),
    Picture("hop_sheet.webp", HOP, "hop/sheet.png", 1200),
    Picture("jump.mp4", JUMP, "jump/jump.mp4", 400),
    Picture("jump.webp", JUMP, "jump/jump.mp4", 400, at=0.45),
    Picture("jump_sheet.webp", JUMP, "jump/sheet.png", 1200),
    Picture("twist.mp4", TWIST, "twist/twist.mp4", 400),
    Picture("twist.webp", TWIST, "twist/twist.mp4", 400, at=0.3),
    Picture("twist_sheet.webp", TWIST, "twist/sheet.png", 1200),
    Picture("walk.mp4", WALK, "stool/walk.mp4", 400),
    Picture("walk.webp", WALK, "stool/walk.mp4", 400, at=0.5),
    Picture("walk_sheet.webp", WALK, "stool/sheet.png", 1200),
    Picture("waddle_sheet.webp", WADDLE, "waddle/sheet.png", 1200),
    Picture("crawl_sheet.webp", CRAWL, "crawl/sheet.png", 1200),
    Picture("turn_sheet.webp", TURN, "turn/sheet.png", 1200),
    Picture("get_up_sheet.webp", GET_UP, "get_up/sheet.png", 1200),
    Picture("dance_sheet.webp", DANCE, "dance/sheet.png", 1200),
    Picture("duel_sheet.webp", DUEL, "duel/sheet.png", 1200),
    Picture("stairs_sheet.webp", STAIRS, "stairs/sheet.png", 1200),
    Picture("board_sheet.webp", BOARD, "board/sheet.png", 1200),
    Picture("scene.mp4", SCENE, "figurine/jump.mp4", 400),
    Picture("scene.webp", SCENE, "figurine/jump.mp4", 400, at=0.45),
    Picture("segment.webp", SCENE, "figurine/segment.png", 1200),
    Picture("filled.webp", SCENE, "figurine/filled.png", 1200),
    Picture("info.webp", INFO, "info.png", 1800),
    Picture("muscles.webp", MUSCLES, "muscles.png", 1200),
    Picture("photos_taking.webp", PHOTOS, "photos/taking.png", 1200),
    Picture("photos_wrong.webp", PHOTOS, "photos/photos.png", 1200),
    Picture("object_wrong.webp", PHOTOS, "photos/object.png", 1200),
)


def run(command: str) -> None:
    """Run a command of a page from the root of the tree with the current Python interpreter."""
    program, *rest = shlex.split(command)
    module = {"python": [], "egs-warp": ["-m", "egs_warp.cli"]}[program]
    subprocess.run([sys.executable, *module, *rest], cwd=ROOT, check=True)


def ffmpeg(*arguments: str) -> None:
    """Run ffmpeg with these arguments."""
    subprocess.run([get_ffmpeg_exe(), "-y", "-loglevel", "error", *arguments], check=True)


def seconds(film: Path) -> float:
    """Return the duration of a film in seconds."""
    output = subprocess.run([get_ffmpeg_exe(), "-i", str(film)], capture_output=True, text=True).stderr
    hours, minutes, rest = output.split("Duration: ")[1].split(",")[0].split(":")
    return 3600 * int(hours) + 60 * int(minutes) + float(rest)


def exported(page: Page) -> Path:
    """Return the path of the exported ``page``; make it and its run if they do not exist."""
    folder, path = ROOT / "out" / page.run, ASSETS / "pages" / f"{page.run}.html"
    if not (folder / "creature.npz").is_file():
        run(page.command)
    if not path.is_file():
        path.parent.mkdir(exist_ok=True)
        run(f"egs-warp view {folder} --export {path}")
        print(f"pages/{path.name}: {path.stat().st_size / 1e6:.1f} MB")
    return path


def record(page: Path, film: Path) -> None:
    """Record a ``page`` in the system's Chromium, from the side, with the path of the centre of mass."""
    with started() as browser, tempfile.TemporaryDirectory() as folder:
        shown, _ = opened(browser, page.as_uri(), *RECORDED)
        controls = ".tools, .dock, .notes, figcaption"
        bare = f"for (const part of document.querySelectorAll('{controls}')) part.style.display = 'none'"
        shown.evaluate(f"() => {{ {bare} }}")
        shown.evaluate(SIDE_VIEW)
        count = shown.evaluate("egs.viewers[0].source.frames.length")
        for number, frame in enumerate(range(0, count, 60 // RECORDED_RATE)):
            shown.evaluate("async (frame) => { egs.player.seek(frame); await egs.viewers[0].drawSorted(); }", frame)
            shown.screenshot(path=f"{folder}/{number:04d}.png")
        lossless = ("-c:v", "libx264", "-qp", "0", "-pix_fmt", "yuv444p")
        ffmpeg("-framerate", str(RECORDED_RATE), "-i", f"{folder}/%04d.png", *lossless, str(film))


def make(picture: Picture) -> None:
    """Write ``picture`` to docs/assets; run its command if its source does not exist."""
    source, target = ROOT / "out" / picture.source, ASSETS / picture.name
    if source.name == "page.mp4" and not source.is_file():
        record(exported(next(page for page in PAGES if page.command == picture.command)), source)
    elif not source.is_file():
        run(picture.command)
    if target.suffix == ".mp4" or target.stem.endswith("_loop"):
        # The last frame is repeated, so that the loop pauses.
        film = target.suffix == ".mp4"
        cut = f"crop=iw:trunc(ih*{1 - picture.sky:g}/2)*2:0:ih-oh"
        shrink = f"fps={30 if film else 20},{cut},scale={picture.width}:-2:flags=lanczos"
        x264 = (
            "-c:v",
            "libx264",
            "-preset",
            "veryslow",
            "-crf",
            "20",
            "-pix_fmt",
            "yuv420p",
            "-movflags",
            "+faststart",
        )
        webp = ("-c:v", "libwebp_anim", "-loop", "0", "-quality", "70")
        hold = f"{shrink},tpad=stop_mode=clone:stop_duration=0.6"
        ffmpeg("-i", str(source), "-vf", hold, "-an", *(x264 if film else webp), str(target))
        return
    still = source
    if source.suffix == ".mp4":
        still = source.with_suffix(".still.png")
        ffmpeg("-ss", f"{picture.at * seconds(source):.3f}", "-i", str(source), "-frames:v", "1", str(still))
    with Image.open(still) as opened:
        small = opened.convert("RGB")
        height = int(small.height * (1 - picture.sky) / 2) * 2
        small = small.crop((0, small.height - height, small.width, small.height))
        small.thumbnail((picture.width, picture.width), Image.Resampling.LANCZOS)
        small.save(target, quality=86, method=6)


def main() -> None:
    """Make the images."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="files of docs/assets, or NAME.html of a page (default all)")
    chosen = parser.parse_args()
    if not (ROOT / "out" / "captures").is_dir():
        run(CAPTURES)
    for page in PAGES:
        if not chosen.names or f"{page.run}.html" in chosen.names:
            exported(page)
    for picture in PICTURES:
        if not chosen.names or picture.name in chosen.names:
            make(picture)
            print(f"{picture.name}: {(ASSETS / picture.name).stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()

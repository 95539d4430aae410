"""Captures of meshes for ``gaits.py --captures``, trained by this package from photographs of a ray caster.

python benchmarks/trained_bodies.py [--quick] [--device cpu] [--seed 0] [--names NAME ...] [--out FOLDER] [--json PATH]

The legs and feet of the trained captures are rough, differ in height and merge, like those of a user's capture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from egs_warp.io import write_ply
from harness import Table, flags, report, timed
from mesh_scenes import trained
from painted_meshes import PaintedMesh, cat, chair, plant, slender_chair, spot, stool

MESHES: dict[str, Callable[[], PaintedMesh]] = {
    "armchair": chair,
    "stool": stool,
    "spot": spot,
    "cat": cat,
    "plant": plant,
    "slender chair": slender_chair,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Train the captures and write them."""
    parser = flags(__doc__, quick="one small capture of the slender chair", device="cpu", seed="seed of the training")
    parser.add_argument("--names", nargs="*", choices=MESHES, help="only these")
    parser.add_argument("--out", type=Path, default=Path("out/trained"), help="folder of NAME.ply (%(default)s)")
    options = parser.parse_args(arguments)
    names = options.names or (["slender chair"] if options.quick else list(MESHES))
    size, views, gaussians, iterations = (96, 12, 1500, 200) if options.quick else (160, 24, 5000, 1000)
    options.out.mkdir(parents=True, exist_ok=True)
    table, rows = Table(capture="<14", gaussians=".0f", seconds=".0f"), []
    for name in names:
        cloud, milliseconds = timed(
            trained,
            MESHES[name](),
            size=size,
            views=views,
            gaussians=gaussians,
            iterations=iterations,
            seed=options.seed,
            device=options.device,
        )
        write_ply(options.out / f"{name.replace(' ', '_')}.ply", cloud)
        rows.append({"capture": name, "gaussians": cloud.count, "seconds": 1e-3 * milliseconds})
        table.row(name, cloud.count, rows[-1]["seconds"])
    report(options, rows, aims={}, why_null={})


if __name__ == "__main__":
    main()

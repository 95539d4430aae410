"""``egs-warp animate SCENE --object a=... --object b=...``: animate several objects of a scene as the bodies of a
world."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from egs_warp.commands.animate_world import WORLD_FLAGS, check_flags, run_world
from egs_warp.commands.flags import NAMED_VALUE, chosen_inpainter, parse_up
from egs_warp.commands.segment import clearing_of
from egs_warp.errors import UserError, did_you_mean

if TYPE_CHECKING:
    from egs_warp.pipelines.scene_script import SceneProgress, SceneRequest

_FLAGS = (
    *("object", "cameras", "view", "mask_model", "up", "flat", "straddling", "inpainter", "trust", "no_inpaint"),
    *("metres_per_unit", "friction", "motion", "prop", "collision_mesh", "save_collision_mesh"),
)
"""Flags that apply to several objects of a scene, in addition to the flags of a world."""


def named_objects(values: Sequence[str] | None) -> dict[str, tuple[str, ...]]:
    """Return the values of ``--object`` by the names of the objects, in the order in which the names first occur. The
    dictionary is empty if no value has a name.

    Raises ``UserError`` if only some of the values have a name.
    """
    objects: dict[str, tuple[str, ...]] = {}
    unnamed = []
    for value in values or ():
        match = None if Path(value).exists() else NAMED_VALUE.fullmatch(value)
        if match is None:
            unnamed.append(value)
        else:
            objects[match[1]] = (*objects.get(match[1], ()), match[2])
    if objects and unnamed:
        raise UserError(
            f"--object {unnamed[0]}: other objects have names; give this one a name, too: name={unnamed[0]}"
        )
    return objects


def motions_of(text: str, names: Sequence[str], props: Sequence[str]) -> dict[str, str]:
    """Return the motion of each creature that has one.

    Args:
        text: ``a: walk 1; b: nod``, or a motion of all creatures.
        names: Names of all objects.
        props: Names of the props.

    Raises:
        UserError: A name is unknown or occurs twice, or names a prop, or a motion is invalid or empty, or is directed
            towards a body that does not exist.
    """
    from egs_warp.motions.towards import check_motion

    parts = [part.strip() for part in text.split(";") if part.strip()] or [""]
    motions: dict[str, str] = {}
    for part in parts:
        name, colon, motion = (each.strip() for each in part.partition(":"))
        if not colon and len(parts) == 1:
            motions = {each: part for each in names if each not in props}
            break
        if not colon or name not in names:
            raise UserError(
                f"--motion {part!r}: it does not begin with the name of an object{did_you_mean(name, names)}; give"
                f" NAME: MOTION, separated by semicolons, for {', '.join(names)}"
            )
        if name in props:
            raise UserError(f"--motion {part!r}: {name} is a prop, which has no muscles; leave --prop {name} out")
        if name in motions:
            raise UserError(
                f"--motion {part!r}: {name} already has a motion; separate the motions of an object by commas"
            )
        motions[name] = motion
    for name, motion in motions.items():
        check_motion(motion, [other for other in names if other != name])
    return motions


def animate_scene_world(args: argparse.Namespace, objects: Mapping[str, tuple[str, ...]]) -> bool:
    """Run ``egs-warp animate`` for several ``objects`` of a scene; return True if the exit status must report a
    failure. The caller has checked the output folder."""
    from egs_warp.pipelines.scene_script import read_scene_parts
    from egs_warp.pipelines.world_file import WorldScript

    check_flags(args, (*WORLD_FLAGS, *_FLAGS, "config"), "it has no effect on several objects of a scene; leave it out")
    props = tuple(args.prop or ())
    for name in props:
        if name not in objects:
            raise UserError(
                f"--prop {name}: no object has this name{did_you_mean(name, objects)}; give one of {', '.join(objects)}"
            )
    motions = motions_of(args.motion, list(objects), props)
    request = _request(args, objects, props)
    asked = {
        "scene": args.capture,
        "bodies": [
            {
                "name": name,
                "object": list(values),
                **({"prop": True} if name in props else {}),
                **({"motion": motions[name]} if name in motions else {}),
            }
            for name, values in objects.items()
        ],
    }

    def read(progress: SceneProgress) -> WorldScript:
        parts = read_scene_parts(request, device=args.device, progress=progress)
        made = parts.scene_world
        return WorldScript(made.world, motions, {}, (*made.notes, *made.world.thin_parts), asked, parts)

    return run_world(args, read)


def _request(args: argparse.Namespace, objects: Mapping[str, tuple[str, ...]], props: Sequence[str]) -> SceneRequest:
    from egs_warp.commands.scene_input import SELECTION_FLAGS
    from egs_warp.pipelines.prepare_scene import SceneOptions
    from egs_warp.pipelines.scene_script import SceneObject, SceneRequest
    from egs_warp.pipelines.scene_world import SceneBody, SceneWorldOptions

    if args.inpainter is not None and args.no_inpaint:
        raise UserError("--inpainter: --no-inpaint leaves the floor as captured; leave one of them out")
    return SceneRequest(
        Path(args.capture),
        {
            name: SceneObject(values, SceneBody(is_prop=name in props), view=args.view)
            for name, values in objects.items()
        },
        args.cameras,
        None if args.up is None else parse_up(args.up),
        args.collision_mesh,
        SceneWorldOptions(args.metres_per_unit, args.friction),
        SceneOptions(
            clearing=clearing_of(args),
            flat=args.flat,
            inpaint=not args.no_inpaint,
            inpainter=chosen_inpainter(args),
        ),
        args.mask_model,
        SELECTION_FLAGS,
    )

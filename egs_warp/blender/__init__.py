"""Blender add-on that plays runs and bundles. Input: the folder of a run, or a bundle. Output: objects in Blender, and
files of edited muscles and cages. No section of the paper describes it; see docs/guide/blender.md.
"""

from __future__ import annotations

from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
from bpy_extras.io_utils import ExportHelper, ImportHelper  # pyright: ignore[reportMissingImports]

from .editing import write_cage, write_muscles
from .performance import Performance, ReadError
from .playback import Playback, add_creature, creature_of, forget, performance_of, show


class ImportCreature(bpy.types.Operator, ImportHelper):
    """Import a bundle of egs-warp export, or the run that the chosen file belongs to"""

    bl_idname = "import_scene.egs_warp"
    bl_label = "Import egs_warp run or bundle"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012
    filename_ext = ".egs"
    filter_glob: bpy.props.StringProperty(default="*.egs;*.npz", options={"HIDDEN"})  # type: ignore[valid-type]
    set_up_scene: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Set up the scene",
        default=True,
        description="Set frame rate, frame range, view transform Standard, transparent bounces of Cycles, and lock"
        " the interface while rendering",
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add the creature to the active collection."""
        try:
            root = add_creature(context, Path(self.filepath), set_up_scene=self.set_up_scene)
        except ReadError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        context.view_layer.objects.active = root
        if performance_of(root).muscles is None:
            self.report({"INFO"}, "The bundle has no muscles, forces and masses; import the folder of the run for them")
        return {"FINISHED"}


class _Export(ExportHelper):
    """Base class of operators that write a part of the active creature to a file."""

    noun: str
    """Noun that follows the number returned by ``write`` in the message to the user."""

    @staticmethod
    def write(path: Path, root: bpy.types.Object, performance: Performance) -> int:
        """Write the file; return the number of written elements, for the message."""
        raise NotImplementedError

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Return True if the active object belongs to a creature."""
        cls.poll_message_set("Select an object of an imported creature")
        return creature_of(context.object) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Write the file."""
        root = creature_of(context.object)
        try:
            count = self.write(Path(self.filepath), root, performance_of(root))
        except (ValueError, OSError, ReadError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Wrote {count} {self.noun} to {self.filepath}")
        return {"FINISHED"}


class ExportMuscles(bpy.types.Operator, _Export):
    """Write the curves to edit of the active creature as muscles for egs-warp animate"""

    bl_idname = "export_scene.egs_warp_muscles"
    bl_label = "Export egs_warp muscles"
    filename_ext, noun, write = ".json", "muscles", staticmethod(write_muscles)
    filter_glob: bpy.props.StringProperty(default="*.json", options={"HIDDEN"})  # type: ignore[valid-type]


class ExportCage(bpy.types.Operator, _Export):
    """Write the cage to edit of the active creature for egs-warp animate"""

    bl_idname = "export_scene.egs_warp_cage"
    bl_label = "Export egs_warp cage"
    filename_ext, noun, write = ".mesh", "nodes", staticmethod(write_cage)
    filter_glob: bpy.props.StringProperty(default="*.mesh", options={"HIDDEN"})  # type: ignore[valid-type]


class PlaybackPanel(bpy.types.Panel):
    """Playback of the active creature"""

    bl_idname = "VIEW3D_PT_egs_warp"
    bl_label = "egs_warp"
    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "egs_warp"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Return True if the active object belongs to a creature."""
        return creature_of(context.object) is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw source, start, speed and the buttons for the exports."""
        root = creature_of(context.object)
        assert root is not None
        self.layout.use_property_split = True
        for name in ("source", "start", "speed"):
            self.layout.prop(root.egs_warp, name)
        self.layout.operator(ExportMuscles.bl_idname, text="Export muscles", icon="EXPORT")
        self.layout.operator(ExportCage.bl_idname, text="Export cage", icon="EXPORT")


_CLASSES = (Playback, ImportCreature, ExportMuscles, ExportCage, PlaybackPanel)


def _import_entry(menu: bpy.types.Menu, _: bpy.types.Context) -> None:
    menu.layout.operator(ImportCreature.bl_idname, text="egs_warp run (.npz) or bundle (.egs)")


def _export_entry(menu: bpy.types.Menu, _: bpy.types.Context) -> None:
    menu.layout.operator(ExportMuscles.bl_idname, text="egs_warp muscles (.json)")
    menu.layout.operator(ExportCage.bl_idname, text="egs_warp cage (.mesh)")


def register() -> None:
    """Add the classes, the menu entries and the handler."""
    for each in _CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Object.egs_warp = bpy.props.PointerProperty(type=Playback)
    bpy.types.TOPBAR_MT_file_import.append(_import_entry)
    bpy.types.TOPBAR_MT_file_export.append(_export_entry)
    bpy.app.handlers.frame_change_pre.append(show)


def unregister() -> None:
    """Remove what ``register`` added."""
    bpy.app.handlers.frame_change_pre.remove(show)
    bpy.types.TOPBAR_MT_file_export.remove(_export_entry)
    bpy.types.TOPBAR_MT_file_import.remove(_import_entry)
    del bpy.types.Object.egs_warp
    for each in reversed(_CLASSES):
        bpy.utils.unregister_class(each)
    forget()

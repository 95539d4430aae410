"""The sub-commands of ``egs-warp``: each module adds its parser with ``add_parser``; heavy imports wait for its run.

In: flags. Out: files and an exit status. Nothing else in the package speaks of flags.
"""

COMMANDS = (
    "animate",
    "convert",
    "doctor",
    "export",
    "inpaint",
    "muscles",
    "plane",
    "pose",
    "samples",
    "segment",
    "train",
    "view",
)

"""The sub-commands of ``egs-warp``: each module adds its parser with ``add_parser``; heavy imports wait for its run.

In: flags. Out: files and an exit status. Beside the paper; nothing else in the package speaks of flags.
"""

GROUPS = {
    "begin": ("doctor", "samples"),
    "captures": ("pose", "train", "convert"),
    "scenes": ("plane", "segment", "inpaint"),
    "motion": ("info", "muscles", "animate", "resume", "live"),
    "finished runs": ("render", "view", "export"),
}
"""Names of the commands, as ``egs-warp --help`` lists them."""

COMMANDS = tuple(name for names in GROUPS.values() for name in names)

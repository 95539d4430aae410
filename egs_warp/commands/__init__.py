"""Sub-commands of ``egs-warp``. Each module adds its parser with ``add_parser``; heavy imports are deferred until the
command runs.

Input: command-line flags. Output: files and an exit status. No other package handles flags. Not part of the paper.
"""

GROUPS = {
    "getting started": ("doctor", "demo", "samples"),
    "captures": ("from-photos", "pose", "train", "convert"),
    "scenes": ("pick", "plane", "segment", "inpaint"),
    "motion": ("info", "muscles", "animate", "resume", "live"),
    "finished runs": ("render", "view", "export", "validate"),
}
"""Command names by group, in the order of ``egs-warp --help``."""

COMMANDS = tuple(name for names in GROUPS.values() for name in names)
"""All command names; each is a module of this package, with underscores for hyphens."""

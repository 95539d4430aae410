"""The sub-commands of ``egs-warp``: each module adds its parser with ``add_parser``; heavy imports wait for its run."""

COMMANDS = ("animate", "inpaint", "muscles", "plane", "segment", "train")

"""Waiting policy of the threads of PyTorch."""

from __future__ import annotations

import os
import subprocess
import sys


def test_a_scene_sets_the_waiting_policy_before_torch_is_imported() -> None:
    """OpenMP reads the policy when PyTorch is imported. A value that the user has set is kept."""
    program = (
        "import os, sys; import egs_warp.pipelines.prepare_scene;"
        " print('torch' in sys.modules, os.environ['OMP_WAIT_POLICY'])"
    )
    for given, expected in ({}, "False PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "False ACTIVE"):
        environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"} | given
        done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
        assert done.stdout.strip().splitlines()[-1] == expected, done.stderr

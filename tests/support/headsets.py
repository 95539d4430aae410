"""An emulated headset with two controllers, by the npm package iwer."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import pytest

from egs_warp.web.page import PAGE

_IWER = PAGE.parent / "client" / "node_modules" / "iwer" / "build" / "iwer.js"
needs_headset = pytest.mark.skipif(not _IWER.is_file(), reason="iwer is not installed in egs_warp/web/client")
HEAD = (0.3, 1.6, -0.2)
"""Position of the emulated head, m, in the local-floor space of WebXR (y up)."""
_SET_UP = """(() => {
    const device = new IWER.XRDevice(IWER.metaQuest3);
    device.installRuntime({ forceInstall: true, polyfillLayers: true });
    device.stereoEnabled = true;
    device.position.set(%s);
    // The specification passes a transform; iwer 2.5 reads a matrix.
    const { getOffsetReferenceSpace } = XRReferenceSpace.prototype;
    XRReferenceSpace.prototype.getOffsetReferenceSpace = function ({ matrix }) {
        return getOffsetReferenceSpace.call(this, matrix);
    };
    window.device = device;
})()"""
_FLOOR = """device.installSEM(class {
    trackedPlanes = new Set();
    trackedMeshes = new Set();
    environmentCanvas = document.createElement("canvas");
    render() {}
    computeHitTestResults() { return [new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, %s, 1])]; }
})"""


@cache
def _emulator() -> str:
    return _IWER.read_text(encoding="utf-8")


def emulation(hit: Sequence[float] | None = None) -> list[str]:
    """Return the scripts that emulate a headset; each of its hit tests finds a floor at ``hit`` (x, y, z), m."""
    scripts = [_emulator(), _SET_UP % ", ".join(map(str, HEAD))]
    return scripts if hit is None else [*scripts, _FLOOR % ", ".join(map(str, hit))]

"""Headless Chromium for the benchmarks of pages: its program, its flags and the renderer of its pages.

Without further flags, Chromium renders on the CPU (SwiftShader). Flags for a GPU are, by OpenGL or by Vulkan::

    --use-angle=gl-egl --ignore-gpu-blocklist
    --use-angle=vulkan --enable-features=Vulkan --disable-vulkan-surface --ignore-gpu-blocklist

Chromium draws at most 60 pictures per second, unless it has ``--disable-frame-rate-limit --disable-gpu-vsync``.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
from typing import Any

REFRESH = 60.0
"""Pictures per second of a usual screen."""

_SOFTWARE = ("SwiftShader", "llvmpipe")
_ALWAYS = ("--enable-unsafe-swiftshader", "--no-sandbox")
_RENDERER = """() => {
    const gl = document.createElement("canvas").getContext("webgl2");
    const name = gl.getExtension("WEBGL_debug_renderer_info");
    return gl.getParameter(name ? name.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
}"""


def browser_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags ``--browser`` (Chromium's program) and ``--browser-flags`` (a list of strings)."""
    parser.add_argument(
        "--browser",
        default=os.environ.get("EGS_WARP_BROWSER") or shutil.which("chromium") or shutil.which("google-chrome"),
        help="Chromium's program; by default $EGS_WARP_BROWSER, chromium or google-chrome",
    )
    parser.add_argument(
        "--browser-flags",
        type=shlex.split,
        default=[],
        metavar="FLAGS",
        help="further flags of Chromium as one argument, such as --browser-flags='--use-angle=vulkan --enable-gpu'",
    )


def check_browser(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End the program with status 2 if there is no Chromium."""
    if options.browser is None or shutil.which(options.browser) is None:
        parser.error(f"{options.browser or 'Chromium'} was not found; install Chromium, or give its path by --browser")


def launched(playwright: Any, options: argparse.Namespace) -> Any:
    """Return Playwright's browser, started with the flags of ``options``."""
    return playwright.chromium.launch(executable_path=options.browser, args=[*_ALWAYS, *options.browser_flags])


def renderer_of(page: Any) -> str:
    """Return the name of the WebGL renderer of a page."""
    return page.evaluate(_RENDERER)


def is_gpu(renderer: str) -> bool:
    """Return False for renderers that draw on the CPU."""
    return not any(name in renderer for name in _SOFTWARE)

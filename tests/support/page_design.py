"""Requirements on the controls of a page: label, tooltip, position within the window and visible focus."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

_CONTROLS = """() => {
    const roots = [document, ...[...document.querySelectorAll("*")].flatMap(({ shadowRoot }) => shadowRoot ?? [])];
    const kinds = "button, input, select, summary, a[href], canvas[tabindex]";
    return roots.flatMap((root) => [...root.querySelectorAll(kinds)]).map((one) => {
        const box = one.getBoundingClientRect();
        const text = one.matches("select, input") ? one.closest("label")?.innerText : one.textContent;
        return {
            control: one.outerHTML.slice(0, 140).replace(/<svg.*/, ""),
            label: (one.getAttribute("aria-label") ?? text ?? "").trim(),
            // A tooltip over the picture itself would be in the way.
            tooltip: one.matches("canvas") ? "none" : one.closest("[title]")?.title ?? "",
            box: one.checkVisibility() ? [box.left, box.right] : null,
        };
    });
}"""
_FOCUS = """() => {
    let one = document.activeElement;
    while (one.shadowRoot?.activeElement) one = one.shadowRoot.activeElement;
    const { outlineStyle, outlineWidth } = getComputedStyle(one);
    return [one.outerHTML.slice(0, 100), outlineStyle, parseFloat(outlineWidth)];
}"""


def check_controls(page: Any, width: int) -> int:
    """Assert that all controls have labels and tooltips and are within a window of ``width`` pixels; return their
    number."""
    controls = page.evaluate(_CONTROLS)
    assert [one["control"] for one in controls if not one["label"]] == []
    assert [one["control"] for one in controls if not one["tooltip"]] == []
    outside = [one for one in controls if one["box"] and not (one["box"][0] >= 0 and one["box"][1] <= width)]
    assert outside == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    return len(controls)


def check_focus(page: Any, count: int) -> None:
    """Assert that ``count`` presses of the tab key reach as many different controls with a visible focus."""
    seen = []
    for _ in range(count):
        page.keyboard.press("Tab")
        control, style, thickness = page.evaluate(_FOCUS)
        assert style == "solid" and thickness >= 2.0, control
        seen.append(control)
    assert len(set(seen)) == count


def contrast(page: Any, text: str, pane: str) -> float:
    """Return the contrast ratio, as defined by WCAG, of the text colour of one element and the background colour of
    another."""
    colours = page.evaluate(
        """([text, pane]) => {
            const style = (selector) => getComputedStyle(document.querySelector(selector));
            return [style(text).color, style(pane).backgroundColor];
        }""",
        [text, pane],
    )
    light = sorted(_luminance(colour) for colour in colours)
    return (light[1] + 0.05) / (light[0] + 0.05)


def _luminance(colour: str) -> float:
    channels = np.array([float(number) for number in re.findall(r"[\d.]+", colour)[:3]]) / 255.0
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])

// Legend of the mechanical layers that are shown.

import { element } from "./dom";
import { LAYER_COLOURS } from "./layer_colours";
import type { Layer } from "./overlays";

type Sample = "stroke" | "thin" | "dashed" | "dot" | "patch";

/** Sample, colour, and text of each line; narrow windows do not show the last part of the text. */
const ENTRIES: Record<Layer, [Sample, keyof typeof LAYER_COLOURS, string, string?][]> = {
  cage: [["thin", "cage", "surface of the cage"]],
  muscles: [
    ["stroke", "contracts", "muscle that shortens"],
    ["stroke", "extends", "muscle that lengthens"],
    ["stroke", "relaxed", "muscle at rest"],
  ],
  contacts: [
    ["dot", "point", "contact point"],
    ["stroke", "force", "contact force", "; half a body height is one body weight"],
    ["thin", "cone", "friction cone"],
  ],
  path: [
    ["dot", "centre", "centre of mass"],
    ["stroke", "past", "its path so far"],
    ["stroke", "future", "its path ahead"],
    ["dashed", "plan", "its plan"],
  ],
  feet: [
    ["patch", "loaded", "foot that carries load"],
    ["patch", "lifted", "lifted foot"],
  ],
};

export class Legend {
  readonly element = element("ul", { class: "legend", "aria-label": "Legend", hidden: "" });
  private readonly groups = new Map<string, HTMLElement[]>();

  /** Create the legend; `hasPlan` is false for a run without a planned path. */
  constructor(hasPlan: boolean) {
    for (const [layer, entries] of Object.entries(ENTRIES)) {
      const rows = entries
        .filter(([, colour]) => hasPlan || colour !== "plan")
        .map(([sample, colour, text, more = ""]) => {
          const mark = element("i", { class: sample });
          mark.style.color = `#${LAYER_COLOURS[colour].toString(16).padStart(6, "0")}`;
          const words = element("span", {}, text, element("span", { class: "more" }, more));
          return element("li", { hidden: "" }, mark, words);
        });
      this.groups.set(layer, rows);
      this.element.append(...rows);
    }
  }

  /** Show or hide the entries of a layer. */
  show(layer: string, visible: boolean): void {
    for (const row of this.groups.get(layer) ?? []) row.hidden = !visible;
    this.element.hidden = [...this.element.children].every((row) => (row as HTMLElement).hidden);
  }
}

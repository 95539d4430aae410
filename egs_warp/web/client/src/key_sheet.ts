// Overview of the functions of keys and pointer.

import { element } from "./dom";

/** Create a hidden sheet. Each entry consists of keys or gestures and a description of their function. */
export function createKeySheet(entries: [string[], string][]): HTMLElement {
  const list = element("dl", { class: "keys" });
  for (const [keys, what] of entries) {
    const names = keys.flatMap((key) => [" ", element("kbd", {}, key)]);
    list.append(element("div", {}, element("dt", {}, ...names), element("dd", {}, what)));
  }
  return element("section", { class: "sheet", "aria-label": "Keys", hidden: "" }, list);
}
